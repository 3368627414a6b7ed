// Color of a tile of 16 rendered samples: texels gathered and decoded, and the gradients.
//
// Lanes 4 g + q hold rows g and g + 8, of the texel channels 4 q .. 4 q + 3 and 16 + 4 q .. 16 + 4 q + 3.
#pragma once

#include "cuda/fused/stage.cuh"
#include "cuda/fused/warp_ray.cuh"
#include "kernels/interpolation.h"

namespace spslam::fused {

// Where the tile's samples lie in the three planes; a warp's shared memory, [plane][row].
struct PlanePlaces {
  float4 at[3][kTileRows];         // fractions u and v, slopes of u and v by the position in texels
  std::int32_t row[3][kTileRows];  // lowest texel
};

struct ColorTile {
  std::uint32_t passed1, passed2;
  float rgb[2][3];
};

// Rows of the texel table to the neighbors along u and v; 0 where the plane has but one.
__device__ __forceinline__ int step_u(const PlaneLayout& plane) {
  return plane.size_u > 1 ? plane.size_v : 0;
}
__device__ __forceinline__ int step_v(const PlaneLayout& plane) {
  return plane.size_v > 1 ? 1 : 0;
}

// The lanes share the 3 x 16 look-ups. Rows past the last one repeat it.
__device__ __forceinline__ void locate_in_planes(const RayStepArguments& a, const RayScratch& scratch, int base,
                                                 int rendered, int lane, PlanePlaces& places) {
  __syncwarp();
#pragma unroll
  for (int task = 0; task < 3 * kTileRows; task += kWarp) {
    const int plane = (task + lane) / kTileRows, row = (task + lane) % kTileRows;
    if (plane >= 3) continue;
    const float4 place = scratch.place[scratch.rendered[min(base + row, rendered - 1)]];
    const Vec3<float> point{place.x, place.y, place.z};
    const PlaneLayout& layout = a.scene.planes.planes[plane];
    const AxisCell<float> u = axis_cell(plane_u(point, plane) * a.inverse_cell, layout.origin_u, layout.size_u);
    const AxisCell<float> v = axis_cell(plane_v(point, plane) * a.inverse_cell, layout.origin_v, layout.size_v);
    places.at[plane][row] = make_float4(u.fraction, v.fraction, u.slope, v.slope);
    places.row[plane][row] = static_cast<std::int32_t>(layout.offset) + u.lower * layout.size_v + v.lower;
  }
  __syncwarp();
}

// The four texels around a sample in one plane, channels c .. c + 3.
struct TexelCorners {
  float4 at[4];  // corner k: k & 1 along u, k >> 1 along v

  __device__ __forceinline__ TexelCorners(const RayStepArguments& a, int plane, std::int32_t row, int channel) {
    const PlaneLayout& layout = a.scene.planes.planes[plane];
    const float* texel = a.scene.texels + kPlaneChannels * static_cast<std::int64_t>(row) + channel;
    const int u = kPlaneSlots * step_u(layout), v = kPlaneSlots * step_v(layout);
    at[0] = *reinterpret_cast<const float4*>(texel);
    at[1] = *reinterpret_cast<const float4*>(texel + u);
    at[2] = *reinterpret_cast<const float4*>(texel + v);
    at[3] = *reinterpret_cast<const float4*>(texel + u + v);
  }

  // Corner values of channel k of the four.
  __device__ __forceinline__ void channel(int k, float (&values)[4]) const {
#pragma unroll
    for (int corner = 0; corner < 4; ++corner) {
      const float4 t = at[corner];
      values[corner] = k == 0 ? t.x : (k == 1 ? t.y : (k == 2 ? t.z : t.w));
    }
  }
};

// Decoder input: the sum of the planes (equation 3).
__device__ __forceinline__ void gather_texels(const RayStepArguments& a, const PlanePlaces& places, int lane,
                                              float (&x)[4][4]) {
#pragma unroll
  for (int r = 0; r < 2; ++r) {
    const int row = lane_row(lane) + 8 * r;
#pragma unroll
    for (int plane = 0; plane < 3; ++plane) {
      const float4 at = places.at[plane][row];
#pragma unroll
      for (int half = 0; half < 2; ++half) {
        const TexelCorners texels(a, plane, places.row[plane][row], 16 * half + 4 * lane_quad(lane));
#pragma unroll
        for (int k = 0; k < 4; ++k) {
          float t[4];
          texels.channel(k, t);
          x[2 * half + k / 2][2 * r + k % 2] += lerp(lerp(t[0], t[1], at.x), lerp(t[2], t[3], at.x), at.y);
        }
      }
    }
  }
}

// RGB of a tile; every lane of a row gets its row's. Stages activations where `stage` is not null.
template <Precision kPrecision>
__device__ __forceinline__ void color_forward(const RayStepArguments& a, const float* image, const PlanePlaces& places,
                                              int lane, ColorTile& tile, Stage<kPrecision>* stage) {
  float x[4][4] = {}, h1[4][4], h2[4][4];
  if (a.planes_cover) gather_texels(a, places, lane, x);
  fill_columns(h1, image + Image::color_bias1, lane);
  layer<kPrecision>(image + Image::color1, x, h1, lane);
  tile.passed1 = rectify(h1);
  fill_columns(h2, image + Image::color_bias2, lane);
  layer<kPrecision>(image + Image::color2, h1, h2, lane);
  tile.passed2 = rectify(h2);
  if (stage) {
    store_tile(stage->color_x, x, lane);
    store_tile(stage->color_h1, h1, lane);
    store_tile(stage->color_h2, h2, lane);
  }
#pragma unroll
  for (int c = 0; c < kColors; ++c) {
    float rows[2];
    dot_rows(h2, image + Image::color3 + kHidden * c, lane, rows);
#pragma unroll
    for (int r = 0; r < 2; ++r) {
      tile.rgb[r][c] = activate(MlpActivation::kSigmoid, rows[r] + image[Image::color_bias3 + c]);
    }
  }
}

// Gradient of the decoder's input from those by the color of the lane's rows. Stages deltas where `stage` is not null.
template <Precision kPrecision>
__device__ __forceinline__ void color_backward(const float* image, const ColorTile& tile, const float (&grad_rgb)[2][3],
                                               int lane, float (&grad_x)[4][4], Stage<kPrecision>* stage) {
  float d3[2][4] = {}, d2[4][4] = {}, d1[4][4] = {};
#pragma unroll
  for (int c = 0; c < kColors; ++c) {
#pragma unroll
    for (int r = 0; r < 2; ++r) d3[r][c] = grad_rgb[r][c] * activation_slope(MlpActivation::kSigmoid, tile.rgb[r][c]);
#pragma unroll
    for (int j = 0; j < 4; ++j) {
      const float2 w =
          *reinterpret_cast<const float2*>(image + Image::color3 + kHidden * c + 8 * j + 2 * lane_quad(lane));
      d2[j][0] += d3[0][c] * w.x, d2[j][1] += d3[0][c] * w.y, d2[j][2] += d3[1][c] * w.x, d2[j][3] += d3[1][c] * w.y;
    }
  }
  mask(d2, tile.passed2);
  layer<kPrecision>(image + Image::color2_back, d2, d1, lane);
  mask(d1, tile.passed1);
#pragma unroll
  for (int j = 0; j < 4; ++j) {
#pragma unroll
    for (int k = 0; k < 4; ++k) grad_x[j][k] = 0.0f;
  }
  layer<kPrecision>(image + Image::color1_back, d1, grad_x, lane);
  if (stage) {
    store_tile(stage->color_d1, d1, lane);
    store_tile(stage->color_d2, d2, lane);
    store_outputs(stage->color_d3, d3, lane);
  }
}

// The lane's share of d L / d point of row r. Reads the texels again: keeping their slopes would take 48 registers.
__device__ __forceinline__ Vec3<float> color_point_gradient(const RayStepArguments& a, const PlanePlaces& places,
                                                            const float (&grad_x)[4][4], int r, int lane) {
  Vec3<float> by_point{0.0f, 0.0f, 0.0f};
  const int row = lane_row(lane) + 8 * r;
#pragma unroll
  for (int plane = 0; plane < 3; ++plane) {
    const float4 at = places.at[plane][row];
    PlaneGradient<float> sum{0.0f, 0.0f};
#pragma unroll
    for (int half = 0; half < 2; ++half) {
      const TexelCorners texels(a, plane, places.row[plane][row], 16 * half + 4 * lane_quad(lane));
#pragma unroll
      for (int k = 0; k < 4; ++k) {
        float t[4];
        texels.channel(k, t);
        const float g = grad_x[2 * half + k / 2][2 * r + k % 2];
        sum.u += g * lerp(t[1] - t[0], t[3] - t[2], at.y);
        sum.v += g * lerp(t[2] - t[0], t[3] - t[1], at.x);
      }
    }
    add_plane_gradient(PlaneGradient<float>{at.z * sum.u, at.w * sum.v}, a.inverse_cell, plane, by_point);
  }
  return by_point;
}

}  // namespace spslam::fused
