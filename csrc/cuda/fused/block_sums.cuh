// Sums over the partial results of a ray kernel's blocks and rays, in a fixed order.
#pragma once

#include "cuda/fused/arguments.cuh"
#include "cuda/fused/column_sums.cuh"
#include "cuda/fused/fragment.cuh"
#include "kernels/ray_source.h"

namespace spslam::fused {

// Units of work of a block of kSumThreads: warp-wide columns of partials, and one frame per warp.
constexpr int kColumnUnits = kPartialSize / kWarp;

// The five losses from the sum of term k in lane first + k.
__device__ __forceinline__ void store_losses(float sum, int first, int lane, const LossWeights& weights,
                                             std::int64_t num_rays, float* losses) {
  const float mean = num_rays > 0 ? sum / static_cast<float>(num_rays) : 0.0f;
  const float terms[4] = {__shfl_sync(kAllLanes, mean, first), __shfl_sync(kAllLanes, mean, first + 1),
                          __shfl_sync(kAllLanes, mean, first + 2), __shfl_sync(kAllLanes, mean, first + 3)};
  if (lane != 0) return;
  losses[0] =
      weights.rgb * terms[0] + weights.depth * terms[1] + weights.free_space * terms[2] + weights.sdf * terms[3];
  for (int k = 0; k < 4; ++k) losses[1 + k] = terms[k];
}

// d L / d pose of a slot, over its rays in order, in all lanes of a warp.
__device__ __forceinline__ void sum_pose_gradients(const float* pose_gradients, const RaySource& rays,
                                                   std::int64_t slot, int lane, float (&grad)[kPoseGradientSize]) {
  constexpr int kRaysAtOnce = kWarp / kPoseGradientStride;
  const std::int64_t begin = first_ray_of_slot(rays, slot), end = first_ray_of_slot(rays, slot + 1);
  const int column = lane % kPoseGradientStride;
  float sum = 0.0f;
  for (std::int64_t r = begin + lane / kPoseGradientStride; r < end; r += kRaysAtOnce) {
    if (column < kPoseGradientSize) sum += __ldcg(pose_gradients + kPoseGradientStride * r + column);
  }
  for (int offset = kPoseGradientStride; offset < kWarp; offset *= 2) sum += __shfl_xor_sync(kAllLanes, sum, offset);
  for (int k = 0; k < kPoseGradientSize; ++k) grad[k] = __shfl_sync(kAllLanes, sum, k);
}

}  // namespace spslam::fused
