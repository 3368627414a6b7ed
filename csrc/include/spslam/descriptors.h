// Binary descriptors of image features (ORB, BRISK, AKAZE, ...) compared by Hamming distance.
#pragma once

#include <cstdint>

#include "core/device.h"

namespace spslam {

constexpr std::int32_t kMaxDescriptorWords = 16;   // of 64 bits
constexpr std::int32_t kMaxDescriptorGroups = 16;  // that are compared in one call

// Descriptors [count, words].
struct Descriptors {
  const std::uint64_t* words;
  std::int64_t count;
};

// Groups of descriptors, say of one image each.
struct DescriptorGroups {
  Descriptors of[kMaxDescriptorGroups];
  std::int32_t count;
};

// For each of `descriptors` the place of the nearest one in each of the groups, the first of several, -1 where there is
// none: [groups, count]; and the distances [groups, count, 2], in bits, to it and to the second nearest; 64 words + 1
// where there is none.
template <class Device>
void nearest_descriptors(Device device, const Descriptors& descriptors, const DescriptorGroups& others,
                         std::int32_t words, std::int64_t* nearest, std::int32_t* distances);

}  // namespace spslam
