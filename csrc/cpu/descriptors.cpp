#include "spslam/descriptors.h"

#include "core/parallel.h"
#include "kernels/descriptors.h"

namespace spslam {
namespace {

constexpr std::int64_t kGrain = 16;
constexpr int kOrbWords = 4;

template <int Words>
void find(const Descriptors& descriptors, const DescriptorGroups& others, std::int32_t words, std::int64_t* nearest,
          std::int32_t* distances) {
  parallel_for(others.count * descriptors.count, kGrain, [&](std::int64_t begin, std::int64_t end) {
    for (std::int64_t i = begin; i < end; ++i) {
      const Descriptors& group = others.of[i / descriptors.count];
      const std::uint64_t* one = descriptors.words + i % descriptors.count * words;
      TwoNearest found(words);
      for (std::int64_t m = 0; m < group.count; ++m) {
        found.show(hamming_distance<Words>(one, group.words + m * words, words), m);
      }
      nearest[i] = found.place;
      distances[2 * i] = found.first;
      distances[2 * i + 1] = found.second;
    }
  });
}

}  // namespace

template <>
void nearest_descriptors<Cpu>(Cpu, const Descriptors& descriptors, const DescriptorGroups& others, std::int32_t words,
                              std::int64_t* nearest, std::int32_t* distances) {
  if (words == kOrbWords) return find<kOrbWords>(descriptors, others, words, nearest, distances);
  find<0>(descriptors, others, words, nearest, distances);
}

}  // namespace spslam
