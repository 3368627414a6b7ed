// Adds the gradients of a tile's samples to the rows of the tables that they were interpolated from.
//
// Samples lie in order of depth, so neighbors often share a cell: sums are kept while the cell stays the same and then
// added to the table as fixed-point integers, whose order does not matter.
#pragma once

#include "cuda/fused/color_tile.cuh"
#include "cuda/fused/geometry_tile.cuh"
#include "kernels/interpolation.h"

namespace spslam::fused {

// Gradient rows of a tile; a warp's shared memory. 48 floats per row avoid bank conflicts.
struct GradientRows {
  float rows[kTileRows][48];
};

// Terms that are too large for the sum, or not finite, count as the largest that fits: a sum of 2^13 of them does.
constexpr float kLargestTerm = 1125899906842624.0f;  // 2^50

__device__ __forceinline__ void add_fixed_point(std::int64_t* sum, float term, float scale) {
  const float scaled = fminf(fmaxf(term * scale, -kLargestTerm), kLargestTerm);
  atomicAdd(reinterpret_cast<unsigned long long*>(sum), static_cast<unsigned long long>(__float2ll_rn(scaled)));
}

// Lane 4 k + q adds up channels 2 q and 2 q + 1 of corner k.
__device__ __forceinline__ void scatter_embeddings(const RayStepArguments& a, const RayScratch& scratch, int base,
                                                   int inside, const float (&grad_x)[2][4], int lane,
                                                   GradientRows& rows) {
  const int row = lane_row(lane), quad = lane_quad(lane), corner = row;
  __syncwarp();
  *reinterpret_cast<float2*>(&rows.rows[row][2 * quad]) = make_float2(grad_x[0][0], grad_x[0][1]);
  *reinterpret_cast<float2*>(&rows.rows[row + 8][2 * quad]) = make_float2(grad_x[0][2], grad_x[0][3]);
  __syncwarp();
  float2 sum = make_float2(0.0f, 0.0f);
  int current = kNoVoxel;
  const auto flush = [&] {
    std::int64_t* out = a.embeddings.sums + kEmbeddingChannels * static_cast<std::int64_t>(current) + 2 * quad;
    add_fixed_point(out, sum.x, a.fixed_point_scale);
    add_fixed_point(out + 1, sum.y, a.fixed_point_scale);
    if (quad == 0 && a.embeddings.stamps) a.embeddings.stamps[current] = a.stamp;
  };
  const int count = min(kTileRows, inside - base);
  for (int i = 0; i < count; ++i) {
    const float4 place = scratch.place[base + i];
    const int id = reinterpret_cast<const int*>(scratch.corners[base + i])[corner];
    if (__any_sync(kAllLanes, id != current)) {
      if (i > 0) flush();
      current = id;
      sum = make_float2(0.0f, 0.0f);
    }
    const float weight = trilinear_weight(place_in_cell(place, a.inverse_voxel), corner);
    const float2 grad = *reinterpret_cast<const float2*>(&rows.rows[i][2 * quad]);
    sum.x += weight * grad.x;
    sum.y += weight * grad.y;
  }
  flush();
}

// Lane c adds up channel c of the four texels of each plane.
__device__ __forceinline__ void scatter_texels(const RayStepArguments& a, const PlanePlaces& places, int base,
                                               int rendered, const float (&grad_x)[4][4], int lane,
                                               GradientRows& rows) {
  const int quad = lane_quad(lane);
  __syncwarp();
#pragma unroll
  for (int r = 0; r < 2; ++r) {
    float* row = rows.rows[lane_row(lane) + 8 * r];
#pragma unroll
    for (int half = 0; half < 2; ++half) {
      *reinterpret_cast<float4*>(row + 16 * half + 4 * quad) =
          make_float4(grad_x[2 * half][2 * r], grad_x[2 * half][2 * r + 1], grad_x[2 * half + 1][2 * r],
                      grad_x[2 * half + 1][2 * r + 1]);
    }
  }
  __syncwarp();
  const int count = min(kTileRows, rendered - base);
#pragma unroll
  for (int plane = 0; plane < 3; ++plane) {
    const PlaneLayout& layout = a.scene.planes.planes[plane];
    const int u = step_u(layout), v = step_v(layout);
    float sums[4] = {0.0f, 0.0f, 0.0f, 0.0f};
    int current = places.row[plane][0];
    const auto flush = [&] {
#pragma unroll
      for (int k = 0; k < 4; ++k) {
        const std::int64_t texel = current + (k & 1) * u + (k >> 1) * v;
        add_fixed_point(a.texels.sums + kPlaneChannels * texel + lane, sums[k], a.fixed_point_scale);
        if (lane == 0 && a.texels.stamps) a.texels.stamps[texel] = a.stamp;
        sums[k] = 0.0f;
      }
    };
    for (int i = 0; i < count; ++i) {
      const float4 at = places.at[plane][i];
      if (places.row[plane][i] != current) {
        flush();
        current = places.row[plane][i];
      }
      float weights[4];
      bilinear_weights(at.x, at.y, weights);
      const float grad = rows.rows[i][lane];
#pragma unroll
      for (int k = 0; k < 4; ++k) sums[k] += weights[k] * grad;
    }
    flush();
  }
}

}  // namespace spslam::fused
