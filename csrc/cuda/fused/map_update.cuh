// The second kernel of a mapping iteration: sums the ray kernel's partial results, and steps all parameters it touched.
#pragma once

#include "cuda/fused/block_sums.cuh"
#include "kernels/optimizer.h"
#include "kernels/pose_adam.h"
#include "kernels/ray_source.h"

namespace spslam::fused {

// A tensor of parameters with its moments, frozen where they are null, and the constants of the step.
struct AdamTarget {
  float *param, *exp_avg, *exp_avg_sq;
  AdamCoefficients<float> coefficients;
};

struct TableTarget {
  AdamTarget adam;
  std::int64_t* sums;
  const std::int32_t* stamps;
  std::int64_t rows;
};

struct MapUpdateArguments {
  const float *partials, *pose_gradients;
  int blocks;  // of the ray kernel
  RaySource rays;
  std::int64_t fixed_row;
  AdamTarget geometry, color, poses;
  TableTarget embeddings, texels;
  float inverse_scale;  // of the tables' sums
  std::int32_t stamp;
  LossWeights weights;
  float* losses;
};

__device__ __forceinline__ void step_parameter(const AdamTarget& t, std::int64_t i, float gradient) {
  adam_update(t.coefficients, t.param[i], gradient, t.exp_avg[i], t.exp_avg_sq[i]);
}

// A warp-wide share of the decoders' parameters and of the loss terms.
__device__ __forceinline__ void step_column(const MapUpdateArguments& a, int unit, float (*shared)[kWarp]) {
  const int lane = threadIdx.x % kWarp;
  const int column = unit * kWarp + lane;
  const float sum = sum_column(a.partials + column, kPartialSize, a.blocks, shared);
  if (threadIdx.x >= kWarp) return;
  constexpr int kGeometryParams = static_cast<int>(kGeometryDecoder.num_params());
  if (column < kGeometryParams) {
    if (a.geometry.exp_avg) step_parameter(a.geometry, column, sum);
  } else if (column < kNumParams) {
    if (a.color.exp_avg) step_parameter(a.color, column - kGeometryParams, sum);
  }
  if (unit == kPartialLosses / kWarp) {
    store_losses(sum, kPartialLosses % kWarp, lane, a.weights, a.rays.num_rays, a.losses);
  }
}

// The pose of a slot, by a warp.
__device__ __forceinline__ void step_pose(const MapUpdateArguments& a, std::int64_t slot, int lane) {
  const std::int64_t row = slot_row(a.rays, slot);
  if (row == a.fixed_row) return;
  float gradient[kPoseGradientSize];
  sum_pose_gradients(a.pose_gradients, a.rays, slot, lane, gradient);
  if (lane != 0) return;
  const std::int64_t at = kPoseSize * row;
  pose_adam(a.poses.coefficients, a.poses.coefficients, gradient, a.poses.param + at, a.poses.exp_avg + at,
            a.poses.exp_avg_sq + at);
}

// Returns four neighboring sums, and sets them to zero.
__device__ __forceinline__ float4 take_sums(std::int64_t* sums, float inverse_scale) {
  longlong2* p = reinterpret_cast<longlong2*>(sums);
  const longlong2 low = __ldcg(p), high = __ldcg(p + 1);
  __stcg(p, make_longlong2(0, 0));
  __stcg(p + 1, make_longlong2(0, 0));
  return make_float4(static_cast<float>(low.x) * inverse_scale, static_cast<float>(low.y) * inverse_scale,
                     static_cast<float>(high.x) * inverse_scale, static_cast<float>(high.y) * inverse_scale);
}

__device__ __forceinline__ void step_four(const TableTarget& t, std::int64_t at, float inverse_scale) {
  float4 gradient = take_sums(t.sums + at, inverse_scale);
  float4* const params = reinterpret_cast<float4*>(t.adam.param + at);
  float4* const firsts = reinterpret_cast<float4*>(t.adam.exp_avg + at);
  float4* const seconds = reinterpret_cast<float4*>(t.adam.exp_avg_sq + at);
  float4 param = __ldcg(params), first = __ldcg(firsts), second = __ldcg(seconds);
  const AdamCoefficients<float>& c = t.adam.coefficients;
  adam_update(c, param.x, gradient.x, first.x, second.x);
  adam_update(c, param.y, gradient.y, first.y, second.y);
  adam_update(c, param.z, gradient.z, first.z, second.z);
  adam_update(c, param.w, gradient.w, first.w, second.w);
  __stcg(params, param);
  __stcg(firsts, first);
  __stcg(seconds, second);
}

// Windows of 32 rows, one for each lane to look at the stamp of; the lanes then share the rows that were touched.
template <int kChannels>
__device__ __forceinline__ void step_window(const TableTarget& t, std::int64_t window, float inverse_scale,
                                            std::int32_t stamp, int lane) {
  constexpr int kLanes = kChannels / 4, kRowsAtOnce = kWarp / kLanes;
  const std::int64_t row = window * kWarp + lane;
  const unsigned touched = __ballot_sync(kAllLanes, row < t.rows && __ldcg(t.stamps + row) == stamp);
  const int count = __popc(touched);
  for (int first = 0; first < count; first += kRowsAtOnce) {
    const int i = first + lane / kLanes;
    if (i >= count) continue;
    const std::int64_t found = window * kWarp + __fns(touched, 0, i + 1);
    step_four(t, kChannels * found + 4 * (lane % kLanes), inverse_scale);
  }
}

__device__ __forceinline__ std::int64_t num_windows(const TableTarget& t) {
  return t.adam.exp_avg ? (t.rows + kWarp - 1) / kWarp : 0;
}

__global__ void __launch_bounds__(kSumThreads) map_update_kernel(const __grid_constant__ MapUpdateArguments a) {
  __shared__ float shared[kSumWarps][kWarp];
  const int lane = threadIdx.x % kWarp, warp = threadIdx.x / kWarp, blocks = gridDim.x;
  const int pose_units = a.poses.exp_avg ? static_cast<int>((a.rays.num_slots + kSumWarps - 1) / kSumWarps) : 0;
  const int units = kColumnUnits + pose_units;
  for (int unit = blockIdx.x; unit < units; unit += blocks) {
    if (unit < kColumnUnits) {
      step_column(a, unit, shared);
    } else {
      const std::int64_t slot = std::int64_t{unit - kColumnUnits} * kSumWarps + warp;
      if (slot < a.rays.num_slots) step_pose(a, slot, lane);
    }
  }
  // Blocks that had no unit above begin with the tables.
  const int turn = (static_cast<int>(blockIdx.x) + blocks - units % blocks) % blocks;
  const std::int64_t embedding_windows = num_windows(a.embeddings), windows = embedding_windows + num_windows(a.texels);
  for (std::int64_t w = std::int64_t{turn} * kSumWarps + warp; w < windows; w += std::int64_t{blocks} * kSumWarps) {
    if (w < embedding_windows) {
      step_window<static_cast<int>(kEmbeddingChannels)>(a.embeddings, w, a.inverse_scale, a.stamp, lane);
    } else {
      step_window<static_cast<int>(kPlaneChannels)>(a.texels, w - embedding_windows, a.inverse_scale, a.stamp, lane);
    }
  }
}

}  // namespace spslam::fused
