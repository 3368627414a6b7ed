// One warp per descriptor and group; its lanes share the group.
#include <cuda_runtime.h>

#include "kernels/descriptors.h"
#include "spslam/descriptors.h"

namespace spslam {
namespace {

constexpr int kWarp = 32, kThreads = 128;
constexpr unsigned kAllLanes = 0xffffffffu;

__global__ void nearest_kernel(Descriptors descriptors, DescriptorGroups others, std::int32_t words,
                               std::int64_t* nearest, std::int32_t* distances) {
  const int lane = threadIdx.x % kWarp;
  const std::int64_t warps = std::int64_t{gridDim.x} * (kThreads / kWarp);
  for (std::int64_t i = (std::int64_t{blockIdx.x} * kThreads + threadIdx.x) / kWarp;
       i < others.count * descriptors.count; i += warps) {
    const Descriptors group = others.of[i / descriptors.count];
    const std::uint64_t* one = descriptors.words + i % descriptors.count * words;
    TwoNearest found(words);
    for (std::int64_t m = lane; m < group.count; m += kWarp) {
      found.show(hamming_distance<0>(one, group.words + m * words, words), m);
    }
    for (int step = kWarp / 2; step > 0; step /= 2) {
      const std::int32_t first = __shfl_xor_sync(kAllLanes, found.first, step);
      const std::int32_t second = __shfl_xor_sync(kAllLanes, found.second, step);
      const long long place = __shfl_xor_sync(kAllLanes, static_cast<long long>(found.place), step);
      found.join(first, second, place);
    }
    if (lane == 0) {
      nearest[i] = found.place;
      distances[2 * i] = found.first;
      distances[2 * i + 1] = found.second;
    }
  }
}

}  // namespace

template <>
void nearest_descriptors<Cuda>(Cuda device, const Descriptors& descriptors, const DescriptorGroups& others,
                               std::int32_t words, std::int64_t* nearest, std::int32_t* distances) {
  if (descriptors.count == 0 || others.count == 0) return;
  constexpr std::int64_t kMostBlocks = 65535;
  const std::int64_t blocks = (others.count * descriptors.count * kWarp + kThreads - 1) / kThreads;
  nearest_kernel<<<static_cast<int>(blocks < kMostBlocks ? blocks : kMostBlocks), kThreads, 0,
                   static_cast<cudaStream_t>(device.stream)>>>(descriptors, others, words, nearest, distances);
}

}  // namespace spslam
