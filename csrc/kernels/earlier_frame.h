// Where a world point falls in an earlier frame's image, and the image between its pixels.
#pragma once

#include <cmath>
#include <cstdint>

#include "core/macros.h"
#include "core/vec.h"
#include "spslam/types/camera.h"

namespace spslam {

constexpr float kMinEarlierDepth = 0.05f;  // m

// Between the pixels (row, column) and (row + 1, column + 1), a of a pixel to the right and b down.
struct FramePlace {
  Vec3<float> seen;  // the point in the frame's camera axes, m
  float inverse_z;   // 1/m
  std::int64_t row, column;
  float a, b;
  bool inside;  // whether it falls between pixels; nothing else is known where not
};

SPS_INLINE FramePlace place_in_frame(const Pose<float>& pose, const Intrinsics& k, std::int64_t height,
                                     std::int64_t width, const Vec3<float>& world) {
  const float* r = pose.rotation.m;
  const Vec3<float> from = world - pose.translation;
  const Vec3<float> seen{r[0] * from.x + r[3] * from.y + r[6] * from.z, r[1] * from.x + r[4] * from.y + r[7] * from.z,
                         r[2] * from.x + r[5] * from.y + r[8] * from.z};
  if (!(seen.z > kMinEarlierDepth)) return {};
  const float inverse_z = 1.0f / seen.z;
  const float u = seen.x * inverse_z * k.fx + k.cx, v = seen.y * inverse_z * k.fy + k.cy;
  if (!(u >= 0.0f && v >= 0.0f && u < static_cast<float>(width - 1) && v < static_cast<float>(height - 1))) return {};
  const float left = std::floor(u), top = std::floor(v);
  return {seen, inverse_z, static_cast<std::int64_t>(top), static_cast<std::int64_t>(left), u - left, v - top, true};
}

// The value between four pixels and its slopes (1/px).
struct BilinearValue {
  float value, by_u, by_v;
};

SPS_INLINE BilinearValue bilinear_value(float c00, float c01, float c10, float c11, float a, float b) {
  const float upper = c00 + a * (c01 - c00), lower = c10 + a * (c11 - c10), by_v = lower - upper;
  return {upper + b * by_v, (1.0f - b) * (c01 - c00) + b * (c11 - c10), by_v};
}

}  // namespace spslam
