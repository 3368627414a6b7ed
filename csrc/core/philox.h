// Counter-based random numbers: the same on every device, with no state to carry.
//
// Philox4x32-10, Salmon et al., "Parallel random numbers: as easy as 1, 2, 3", SC 2011.
#pragma once

#include <cstdint>

#include "core/macros.h"

namespace spslam {

// What a draw is for. Two draws share no counter unless stream, frame, iteration and element all agree.
// spslam/ops/ray_sampling.py repeats these numbers.
enum class RandomStream : std::uint32_t {
  kPixelDatabase = 0,
  kTrackingPixels = 1,
  kTrackingRays = 2,
  kMappingPixels = 3,
  kMappingRays = 4,
  kFrameSelection = 5,
  kCovisibility = 6,
  kEncoderPoints = 7,
  kInitialization = 8,
  kEvaluation = 9,
};

struct PhiloxKey {
  std::uint64_t seed;
  std::uint32_t stream, frame, iteration;
};

struct Philox4 {
  std::uint32_t x, y, z, w;
};

SPS_INLINE Philox4 philox(const PhiloxKey& key, std::uint32_t element) {
  std::uint32_t c0 = element, c1 = key.iteration, c2 = key.frame, c3 = key.stream;
  std::uint32_t k0 = static_cast<std::uint32_t>(key.seed), k1 = static_cast<std::uint32_t>(key.seed >> 32);
  for (int round = 0; round < 10; ++round) {
    const std::uint64_t p0 = static_cast<std::uint64_t>(0xD2511F53u) * c0;
    const std::uint64_t p1 = static_cast<std::uint64_t>(0xCD9E8D57u) * c2;
    c0 = static_cast<std::uint32_t>(p1 >> 32) ^ c1 ^ k0;
    c1 = static_cast<std::uint32_t>(p1);
    c2 = static_cast<std::uint32_t>(p0 >> 32) ^ c3 ^ k1;
    c3 = static_cast<std::uint32_t>(p0);
    k0 += 0x9E3779B9u;
    k1 += 0xBB67AE85u;
  }
  return {c0, c1, c2, c3};
}

// Uniform in [0, 1) from the 24 high bits, so that every value is exact in float32.
SPS_INLINE float uniform_from_bits(std::uint32_t bits) {
  return static_cast<float>(bits >> 8) * (1.0f / 16777216.0f);
}

SPS_INLINE float philox_uniform(const PhiloxKey& key, std::uint32_t element) {
  return uniform_from_bits(philox(key, element).x);
}

// Uniform integer in [0, upper), upper at most 2^32.
SPS_INLINE std::int64_t philox_index(const PhiloxKey& key, std::uint32_t element, std::uint64_t upper) {
  return static_cast<std::int64_t>((static_cast<std::uint64_t>(philox(key, element).x) * upper) >> 32);
}

}  // namespace spslam
