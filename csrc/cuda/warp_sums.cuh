// Sums of many values at once over a warp.
#pragma once

#include "cuda/fused/fragment.cuh"

namespace spslam {

using fused::kAllLanes;
using fused::kWarp;

// Sums 32 values per lane over the warp, in a fixed tree: lane i returns the total of values[i]; `values` is
// overwritten.
template <int kWidth = kWarp / 2>
__device__ __forceinline__ float transpose_sum(float (&values)[kWarp], int lane) {
  const bool upper = lane & kWidth;
#pragma unroll
  for (int i = 0; i < kWidth; ++i) {
    const float sent = upper ? values[i] : values[i + kWidth];
    const float kept = upper ? values[i + kWidth] : values[i];
    values[i] = kept + __shfl_xor_sync(kAllLanes, sent, kWidth);
  }
  if constexpr (kWidth > 1) return transpose_sum<kWidth / 2>(values, lane);
  return values[0];
}

}  // namespace spslam
