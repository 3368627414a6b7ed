// Projection of a world point into an earlier frame's image, and interpolation between its pixels.
#pragma once

#include <cmath>
#include <cstdint>

#include "core/macros.h"
#include "core/vec.h"
#include "spslam/types/camera.h"

namespace spslam {

constexpr float kMinEarlierDepth = 0.05f;  // m

// Between the pixels (row, column) and (row + 1, column + 1), a of a pixel to the right and b down.
struct FrameProjection {
  Vec3<float> in_camera;  // the point in the frame's camera axes, m
  float inverse_z;        // 1/m
  std::int64_t row, column;
  float a, b;
  bool inside;  // whether the point falls between pixels; nothing else is known where not
};

SPS_INLINE FrameProjection project_into_frame(const Pose<float>& pose, const Intrinsics& k, std::int64_t height,
                                              std::int64_t width, const Vec3<float>& world) {
  const float* r = pose.rotation.m;
  const Vec3<float> from = world - pose.translation;
  const Vec3<float> in_camera{r[0] * from.x + r[3] * from.y + r[6] * from.z,
                              r[1] * from.x + r[4] * from.y + r[7] * from.z,
                              r[2] * from.x + r[5] * from.y + r[8] * from.z};
  if (!(in_camera.z > kMinEarlierDepth)) return {};
  const float inverse_z = 1.0f / in_camera.z;
  const float u = in_camera.x * inverse_z * k.fx + k.cx, v = in_camera.y * inverse_z * k.fy + k.cy;
  if (!(u >= 0.0f && v >= 0.0f && u < static_cast<float>(width - 1) && v < static_cast<float>(height - 1))) return {};
  const float left = std::floor(u), top = std::floor(v);
  return {in_camera, inverse_z, static_cast<std::int64_t>(top), static_cast<std::int64_t>(left), u - left,
          v - top,   true};
}

// The value between four pixels and its derivatives (1/px).
struct BilinearValue {
  float value, by_u, by_v;
};

SPS_INLINE BilinearValue bilinear_value(float c00, float c01, float c10, float c11, float a, float b) {
  const float upper = c00 + a * (c01 - c00), lower = c10 + a * (c11 - c10), by_v = lower - upper;
  return {upper + b * by_v, (1.0f - b) * (c01 - c00) + b * (c11 - c10), by_v};
}

}  // namespace spslam
