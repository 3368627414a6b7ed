// for_each(device, n, f): f(i) for every i in [0, n), in parallel. Each i must write its own outputs only.
#pragma once

#include <cstdint>

#include "core/device.h"
#include "core/parallel.h"

#if defined(__CUDACC__)
#include <cuda_runtime.h>
#endif

namespace spslam {

constexpr std::int64_t kElementGrain = 1024;

template <class F>
void for_each(Cpu, std::int64_t n, const F& f, std::int64_t grain = kElementGrain) {
  parallel_for(n, grain, [&f](std::int64_t begin, std::int64_t end) {
    for (std::int64_t i = begin; i < end; ++i) f(i);
  });
}

#if defined(__CUDACC__)
namespace detail {
template <class F>
__global__ void for_each_kernel(std::int64_t n, F f) {
  const std::int64_t stride = static_cast<std::int64_t>(gridDim.x) * blockDim.x;
  for (std::int64_t i = blockIdx.x * static_cast<std::int64_t>(blockDim.x) + threadIdx.x; i < n; i += stride) f(i);
}
}  // namespace detail

template <class F>
void for_each(Cuda device, std::int64_t n, const F& f, std::int64_t = kElementGrain) {
  if (n == 0) return;
  constexpr int kThreads = 256;
  constexpr std::int64_t kMaxBlocks = 65535;
  const std::int64_t blocks = (n + kThreads - 1) / kThreads;
  detail::for_each_kernel<<<static_cast<int>(blocks < kMaxBlocks ? blocks : kMaxBlocks), kThreads, 0,
                            static_cast<cudaStream_t>(device.stream)>>>(n, f);
}
#endif

}  // namespace spslam
