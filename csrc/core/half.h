// Conversion to IEEE half precision on its bits: not every compiler has a type for it.
#pragma once

#include <cstdint>

#include "core/macros.h"

namespace spslam {

// Bits of the half nearest to a float, ties to even; too large ones become infinity. x must not be NaN.
SPS_INLINE std::uint16_t half_bits(float x) {
  constexpr std::uint32_t kInfinity = 0x7c00u, kSmallestNormal = 113u << 23, kTooLarge = 143u << 23;
  std::uint32_t bits;
  __builtin_memcpy(&bits, &x, sizeof bits);
  const std::uint32_t sign = (bits >> 16) & 0x8000u;
  bits &= 0x7fffffffu;
  if (bits >= kTooLarge) return static_cast<std::uint16_t>(sign | kInfinity);
  if (bits < kSmallestNormal) {
    // Adding 1/2 leaves multiples of 2^-24, rounded, in the low bits.
    float shifted;
    __builtin_memcpy(&shifted, &bits, sizeof shifted);
    shifted += 0.5f;
    __builtin_memcpy(&bits, &shifted, sizeof bits);
    return static_cast<std::uint16_t>(sign | (bits - (126u << 23)));
  }
  const std::uint32_t rounded = bits + 0x0fffu + ((bits >> 13) & 1u);
  return static_cast<std::uint16_t>(sign | ((rounded - (112u << 23)) >> 13));
}

}  // namespace spslam
