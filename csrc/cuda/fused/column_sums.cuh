// Sums of columns over the blocks' partial results, one row per block, in a fixed order.
#pragma once

#include <cstdint>

#include "cuda/fused/fragment.cuh"

namespace spslam::fused {

constexpr int kSumThreads = 256, kSumWarps = kSumThreads / kWarp;

// The sum of the column that begins at the lane's `first`, in all warps; warp w adds rows w, w + 8, .. first. All
// threads of a block of kSumThreads take part.
template <class T>
__device__ __forceinline__ T sum_column(const T* first, std::int64_t stride, int rows, T (*shared)[kWarp]) {
  const int lane = threadIdx.x % kWarp, warp = threadIdx.x / kWarp;
  T sum = 0;
#pragma unroll 8
  for (int row = warp; row < rows; row += kSumWarps) sum += __ldcg(first + row * stride);
  __syncthreads();  // the sums before may still be read
  shared[warp][lane] = sum;
  __syncthreads();
  T total = 0;
  for (int w = 0; w < kSumWarps; ++w) total += shared[w][lane];
  return total;
}

}  // namespace spslam::fused
