// The two nearest of many binary descriptors.
#pragma once

#include <cstdint>

#include "core/macros.h"

namespace spslam {

SPS_INLINE std::int32_t set_bits(std::uint64_t word) {
#if defined(__CUDA_ARCH__)
  return __popcll(word);
#else
  return __builtin_popcountll(word);
#endif
}

// `Words` is their number where it is known when this is compiled, else 0.
template <int Words>
SPS_INLINE std::int32_t hamming_distance(const std::uint64_t* one, const std::uint64_t* other, std::int32_t words) {
  std::int32_t distance = 0;
  const std::int32_t count = Words > 0 ? Words : words;
  for (std::int32_t w = 0; w < count; ++w) distance += set_bits(one[w] ^ other[w]);
  return distance;
}

// The nearest of those that were shown, the first of several, and the distances to it and to the second nearest.
struct TwoNearest {
  std::int32_t first, second;  // distances
  std::int64_t place;

  SPS_INLINE explicit TwoNearest(std::int32_t words) : first(64 * words + 1), second(first), place(-1) {}

  // Those at lower places are shown before.
  SPS_INLINE void show(std::int32_t distance, std::int64_t at) {
    if (distance >= second) return;
    if (distance < first) {
      second = first;
      first = distance;
      place = at;
    } else {
      second = distance;
    }
  }

  // Those that another one was shown, at any places.
  SPS_INLINE void join(std::int32_t other_first, std::int32_t other_second, std::int64_t other_place) {
    const bool is_nearer = other_first < first || (other_first == first && other_place >= 0 && other_place < place);
    const std::int32_t farther = is_nearer ? first : other_first;
    const std::int32_t seconds = second < other_second ? second : other_second;
    if (is_nearer) {
      first = other_first;
      place = other_place;
    }
    second = farther < seconds ? farther : seconds;
  }
};

}  // namespace spslam
