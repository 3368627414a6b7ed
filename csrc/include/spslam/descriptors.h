// Binary descriptors of image features (ORB, BRISK, AKAZE, ...) compared by Hamming distance.
#pragma once

#include <cstdint>

#include "core/device.h"

namespace spslam {

constexpr std::int32_t kMaxDescriptorWords = 16;  // of 64 bits

// Descriptors [count, words].
struct Descriptors {
  const std::uint64_t* words;
  std::int64_t count;
};

// For each of `descriptors` the place of the nearest one of `others`, the first of several, -1 where there is none, and
// the distances [count, 2], in bits, to it and to the second nearest; 64 words + 1 where there is none.
template <class Device>
void nearest_descriptors(Device device, const Descriptors& descriptors, const Descriptors& others, std::int32_t words,
                         std::int64_t* nearest, std::int32_t* distances);

}  // namespace spslam
