// Geometry of a tile of 16 samples: embeddings gathered and decoded, and the gradients.
//
// Lanes 4 g + q hold rows g and g + 8, of the embedding channels 2 q and 2 q + 1.
#pragma once

#include "cuda/fused/stage.cuh"
#include "cuda/fused/warp_ray.cuh"
#include "kernels/interpolation.h"

namespace spslam::fused {

struct GeometryTile {
  float2 slope[2][3];  // of the lane's two channels by the position in the cell
  std::uint32_t passed1, passed2;
  float sdf[2];
};

// Value at the sample's place in its cell, and derivatives by it, for one channel.
__device__ __forceinline__ float interpolate_corners(const float (&e)[kCellCorners], const Vec3<float>& local,
                                                     float (&slope)[3]) {
  const Vec3<float> gradient = trilinear_gradient(local, e);
  slope[0] = gradient.x, slope[1] = gradient.y, slope[2] = gradient.z;
  return lerp(lerp(lerp(e[0], e[1], local.x), lerp(e[2], e[3], local.x), local.y),
              lerp(lerp(e[4], e[5], local.x), lerp(e[6], e[7], local.x), local.y), local.z);
}

__device__ __forceinline__ Vec3<float> place_in_cell(const float4& place, float inverse_voxel) {
  return voxel_cell(Vec3<float>{place.x, place.y, place.z}, inverse_voxel).local;
}

// Decoder input of rows [base, base + 16) of the samples inside; rows past the last one repeat it.
__device__ __forceinline__ void gather_embeddings(const RayStepArguments& a, const RayScratch& scratch, int base,
                                                  int inside, int lane, float (&x)[2][4], GeometryTile& tile) {
  const int quad = lane_quad(lane);
#pragma unroll
  for (int r = 0; r < 2; ++r) {
    const int i = min(base + lane_row(lane) + 8 * r, inside - 1);
    const float4 place = scratch.place[i];
    const int4 low = scratch.corners[i][0], high = scratch.corners[i][1];
    const int ids[kCellCorners] = {low.x, low.y, low.z, low.w, high.x, high.y, high.z, high.w};
    float first[kCellCorners], second[kCellCorners], slope_first[3], slope_second[3];
#pragma unroll
    for (int k = 0; k < kCellCorners; ++k) {
      const float2 e = *reinterpret_cast<const float2*>(
          a.scene.embeddings + kEmbeddingChannels * static_cast<std::int64_t>(ids[k]) + 2 * quad);
      first[k] = e.x;
      second[k] = e.y;
    }
    const Vec3<float> local = place_in_cell(place, a.inverse_voxel);
    x[0][2 * r] = interpolate_corners(first, local, slope_first);
    x[0][2 * r + 1] = interpolate_corners(second, local, slope_second);
#pragma unroll
    for (int k = 0; k < 3; ++k) tile.slope[r][k] = make_float2(slope_first[k], slope_second[k]);
    const float scale = a.scene.position_scale;
    const float px = (place.x - a.scene.origin[0]) * scale, py = (place.y - a.scene.origin[1]) * scale;
    const float pz = (place.z - a.scene.origin[2]) * scale;
    x[1][2 * r] = quad == 0 ? px : (quad == 1 ? pz : 0.0f);
    x[1][2 * r + 1] = quad == 0 ? py : (quad == 1 ? 1.0f : 0.0f);
  }
}

// SDF of a tile; every lane of a row gets its row's. Stages activations where `stage` is not null.
template <Precision kPrecision>
__device__ __forceinline__ void geometry_forward(const RayStepArguments& a, const float* image,
                                                 const RayScratch& scratch, int base, int inside, int lane,
                                                 GeometryTile& tile, Stage<kPrecision>* stage) {
  float x[2][4], h1[4][4] = {}, h2[4][4];
  gather_embeddings(a, scratch, base, inside, lane, x, tile);
  layer<kPrecision>(image + Image::geometry1, x, h1, lane);
  tile.passed1 = rectify(h1);
  fill_columns(h2, image + Image::geometry_bias2, lane);
  layer<kPrecision>(image + Image::geometry2, h1, h2, lane);
  tile.passed2 = rectify(h2);
  if (stage) {
    store_tile(stage->geometry_x, x, lane);
    store_tile(stage->geometry_h1, h1, lane);
    store_tile(stage->geometry_h2, h2, lane);
  }
  dot_rows(h2, image + Image::geometry3, lane, tile.sdf);
#pragma unroll
  for (int r = 0; r < 2; ++r) {
    tile.sdf[r] = activate(MlpActivation::kTanh, tile.sdf[r] + image[Image::geometry_bias3]);
  }
}

// Gradient of the decoder's input from those by the SDF of the lane's rows. Stages deltas where `stage` is not null.
template <Precision kPrecision>
__device__ __forceinline__ void geometry_backward(const float* image, const GeometryTile& tile,
                                                  const float (&grad_sdf)[2], int lane, float (&grad_x)[2][4],
                                                  Stage<kPrecision>* stage) {
  float d3[2][4] = {}, d2[4][4], d1[4][4] = {};
#pragma unroll
  for (int r = 0; r < 2; ++r) d3[r][0] = grad_sdf[r] * activation_slope(MlpActivation::kTanh, tile.sdf[r]);
#pragma unroll
  for (int j = 0; j < 4; ++j) {
    const float2 w = *reinterpret_cast<const float2*>(image + Image::geometry3 + 8 * j + 2 * lane_quad(lane));
    d2[j][0] = d3[0][0] * w.x, d2[j][1] = d3[0][0] * w.y, d2[j][2] = d3[1][0] * w.x, d2[j][3] = d3[1][0] * w.y;
  }
  mask(d2, tile.passed2);
  layer<kPrecision>(image + Image::geometry2_back, d2, d1, lane);
  mask(d1, tile.passed1);
#pragma unroll
  for (int j = 0; j < 2; ++j) {
#pragma unroll
    for (int k = 0; k < 4; ++k) grad_x[j][k] = 0.0f;
  }
  layer<kPrecision>(image + Image::geometry1_back, d1, grad_x, lane);
  if (stage) {
    store_tile(stage->geometry_d1, d1, lane);
    store_tile(stage->geometry_d2, d2, lane);
    store_outputs(stage->geometry_d3, d3, lane);
  }
}

// The lane's share of d L / d point of row r.
__device__ __forceinline__ Vec3<float> geometry_point_gradient(const RayStepArguments& a, const GeometryTile& tile,
                                                               const float (&grad_x)[2][4], int r, int lane) {
  const int quad = lane_quad(lane);
  float by_axis[3];
#pragma unroll
  for (int k = 0; k < 3; ++k) {
    const float2 slope = tile.slope[r][k];
    by_axis[k] = a.inverse_voxel * (grad_x[0][2 * r] * slope.x + grad_x[0][2 * r + 1] * slope.y);
  }
  const float first = a.scene.position_scale * grad_x[1][2 * r], second = a.scene.position_scale * grad_x[1][2 * r + 1];
  if (quad == 0) by_axis[0] += first, by_axis[1] += second;
  if (quad == 1) by_axis[2] += first;
  return {by_axis[0], by_axis[1], by_axis[2]};
}

}  // namespace spslam::fused
