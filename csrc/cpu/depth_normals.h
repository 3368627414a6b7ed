// Normals of a depth image on the CPU: vectors over pixels.
#pragma once

#include <algorithm>
#include <cstdint>

#include "cpu/simd.h"
#include "kernels/depth_normal.h"

namespace spslam {

// A depth image with a border of invalid pixels as wide as the smoothing window reaches, so that no window leaves it.
class PaddedDepth {
 public:
  PaddedDepth(std::int32_t width, std::int32_t height)
      : width_(width), height_(height), stride_(width + 2 * kSmoothingRadius) {}

  // Memory for the whole, with the border set; `buffer` must outlive this. Fill the rows before the first use.
  void allocate(ScratchBuffer<float>& buffer) {
    const std::int64_t rows = height_ + 2 * kSmoothingRadius;
    float* begin = buffer.reserve(rows * stride_);
    origin_ = begin + kSmoothingRadius * (stride_ + 1);
    std::fill(begin, origin_ - kSmoothingRadius, 0.0f);
    for (std::int32_t v = 0; v < height_; ++v) {
      std::fill(row(v) - kSmoothingRadius, row(v), 0.0f);
      std::fill(row(v) + width_, row(v) + width_ + kSmoothingRadius, 0.0f);
    }
    std::fill(row(height_) - kSmoothingRadius, begin + rows * stride_, 0.0f);
  }

  float* row(std::int32_t v) { return origin_ + v * stride_; }
  const float* origin() const { return origin_; }
  std::int64_t stride() const { return stride_; }

 private:
  std::int32_t width_, height_;
  std::int64_t stride_;
  float* origin_ = nullptr;
};

// Smoothed depths of kPixelBatch pixels, given as places relative to the image's first pixel.
constexpr int kPixelBatch = 16;

inline void smoothed_depths(const PaddedDepth& depth, const std::int32_t (&places)[kPixelBatch],
                            float (&smoothed)[kPixelBatch]) {
  alignas(64) float center[kPixelBatch], weights[kPixelBatch] = {}, differences[kPixelBatch] = {};
  SPS_SIMD for (int i = 0; i < kPixelBatch; ++i) center[i] = depth.origin()[places[i]];
  // Computed before the loop: a choice between constants in it prevents unrolling.
  const float spatial[kSmoothingRadius + 1] = {smoothing_weight(0), smoothing_weight(1), smoothing_weight(2)};
  for (int dv = -kSmoothingRadius; dv <= kSmoothingRadius; ++dv) {
    for (int du = -kSmoothingRadius; du <= kSmoothingRadius; ++du) {
      const float* shifted = depth.origin() + dv * depth.stride() + du;
      const float row_weight = spatial[dv < 0 ? -dv : dv];
      const float column_weight = spatial[du < 0 ? -du : du];
      SPS_SIMD for (int i = 0; i < kPixelBatch; ++i) {
        add_to_window(center[i], shifted[places[i]], row_weight, column_weight, weights[i], differences[i]);
      }
    }
  }
  SPS_SIMD for (int i = 0; i < kPixelBatch; ++i) smoothed[i] = window_mean(center[i], weights[i], differences[i]);
}

// Normals [n, 3] of n <= kPixelBatch pixels (u, v); pixels may lie outside the image.
inline void normals_of_batch(const DepthImage& image, const PaddedDepth& depth, const std::int32_t* u,
                             const std::int32_t* v, int n, std::int32_t step_px, float max_jump, float* normals) {
  alignas(64) std::int32_t places[5][kPixelBatch];
  alignas(64) float z[5][kPixelBatch], x[kPixelBatch] = {}, y[kPixelBatch] = {}, normal[3][kPixelBatch];
  const std::int32_t stride = static_cast<std::int32_t>(depth.stride());
  for (int i = 0; i < kPixelBatch; ++i) {
    const bool inside = i < n && cross_in_image(image, u[i], v[i], step_px);
    const std::int32_t place = inside ? v[i] * stride + u[i] : 0;
    const std::int32_t right = inside ? step_px : 0, below = right * stride;
    places[0][i] = place;
    places[1][i] = place - right;
    places[2][i] = place + right;
    places[3][i] = place - below;
    places[4][i] = place + below;
    x[i] = inside ? static_cast<float>(u[i]) : -1.0f;
    y[i] = inside ? static_cast<float>(v[i]) : 0.0f;
  }
  for (int k = 0; k < 5; ++k) smoothed_depths(depth, places[k], z[k]);
  const float step = static_cast<float>(step_px);
  SPS_SIMD for (int i = 0; i < kPixelBatch; ++i) {
    const DepthCross cross{x[i] < 0.0f ? 0.0f : z[0][i], z[1][i], z[2][i], z[3][i], z[4][i]};
    const Vec3<float> result = normal_of_cross(image.camera, x[i], y[i], step, max_jump, cross);
    normal[0][i] = result.x;
    normal[1][i] = result.y;
    normal[2][i] = result.z;
  }
  for (int i = 0; i < n; ++i) {
    for (int a = 0; a < 3; ++a) normals[3 * i + a] = normal[a][i];
  }
}

}  // namespace spslam
