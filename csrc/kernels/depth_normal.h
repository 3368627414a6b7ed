// The normal of a depth image's surface at a pixel. Without branches, so that a compiler can vectorize over pixels.
#pragma once

#include <cmath>
#include <cstdint>

#include "core/macros.h"
#include "core/math.h"
#include "core/vec.h"
#include "spslam/prior_fusion.h"

namespace spslam {

// Depth is smoothed over a 5x5 window: a Gaussian of 2 px in the image, Tukey's biweight in depth. It is as curved at 0
// as a Gaussian of 3 cm and, unlike it, exactly 0 beyond 6 cm.
constexpr int kSmoothingRadius = 2;

SPS_INLINE float smoothing_weight(int offset_px) {
  const int distance = offset_px < 0 ? -offset_px : offset_px;
  return distance == 0 ? 1.0f : distance == 1 ? 0.8824969f : 0.6065307f;
}

// Adds the pixel of depth z to the window around one of depth `center`. Depths are 0, for invalid, or positive.
SPS_INLINE void add_to_window(float center, float z, float row_weight, float column_weight, float& weights,
                              float& differences) {
  constexpr float kInverseRange2 = 1.0f / (0.06f * 0.06f);
  const float difference = z - center;
  const float closeness = 1.0f - difference * difference * kInverseRange2;
  const float weight = (closeness > 0.0f) & (z > 0.0f) ? closeness * closeness * row_weight * column_weight : 0.0f;
  weights += weight;
  differences += weight * difference;
}

// The window's mean; 0 where its middle is invalid.
SPS_INLINE float window_mean(float center, float weights, float differences) {
  return center > 0.0f ? center + differences / weights : 0.0f;
}

// Smoothed depth (m) of a pixel and of its neighbors at some step along the axes; 0 where invalid.
struct DepthCross {
  float center, left, right, up, down;
};

SPS_INLINE Vec3<float> unproject(const Intrinsics& camera, float u, float v, float z) {
  return {(u - camera.cx) / camera.fx * z, (v - camera.cy) / camera.fy * z, z};
}

// Unit normal, turned to the camera, by central differences; 0 where a depth is invalid or differs from the pixel's by
// the share max_jump of it, or more.
SPS_INLINE Vec3<float> normal_of_cross(const Intrinsics& camera, float u, float v, float step_px, float max_jump,
                                       const DepthCross& z) {
  const float horizontal_jump = larger(std::fabs(z.left - z.center), std::fabs(z.right - z.center));
  const float vertical_jump = larger(std::fabs(z.up - z.center), std::fabs(z.down - z.center));
  const bool smooth = (horizontal_jump < max_jump * z.center) & (vertical_jump < max_jump * z.center);
  const bool measured = (z.center > 0.0f) & (z.left > 0.0f) & (z.right > 0.0f) & (z.up > 0.0f) & (z.down > 0.0f);
  const Vec3<float> horizontal = unproject(camera, u + step_px, v, z.right) - unproject(camera, u - step_px, v, z.left);
  const Vec3<float> vertical = unproject(camera, u, v + step_px, z.down) - unproject(camera, u, v - step_px, z.up);
  const Vec3<float> normal = cross(horizontal, vertical);
  const float length = std::sqrt(dot(normal, normal));
  const float side = dot(normal, unproject(camera, u, v, z.center)) > 0.0f ? -1.0f : 1.0f;
  const float scale = side / length;
  const bool known = measured & smooth & (length > 0.0f);
  return {known ? scale * normal.x : 0.0f, known ? scale * normal.y : 0.0f, known ? scale * normal.z : 0.0f};
}

// Whether the pixel and its neighbors at step_px lie in the image.
SPS_INLINE bool cross_in_image(const DepthImage& image, std::int32_t u, std::int32_t v, std::int32_t step_px) {
  return (u >= step_px) & (v >= step_px) & (u < image.width - step_px) & (v < image.height - step_px);
}

// A pixel's depth; 0 where it is invalid.
SPS_INLINE float valid_depth(float z) {
  constexpr float kLargest = 3.40282347e38f;
  return (z > 0.0f) & (z <= kLargest) ? z : 0.0f;
}

SPS_INLINE float smoothed_depth(const DepthImage& image, std::int32_t u, std::int32_t v) {
  const float center = valid_depth(image.depth[static_cast<std::int64_t>(v) * image.width + u]);
  float weights = 0.0f, differences = 0.0f;
  for (int dv = -kSmoothingRadius; dv <= kSmoothingRadius; ++dv) {
    if (v + dv < 0 || v + dv >= image.height) continue;
    const float* row = image.depth + static_cast<std::int64_t>(v + dv) * image.width;
    for (int du = -kSmoothingRadius; du <= kSmoothingRadius; ++du) {
      if (u + du < 0 || u + du >= image.width) continue;
      add_to_window(center, valid_depth(row[u + du]), smoothing_weight(dv), smoothing_weight(du), weights, differences);
    }
  }
  return window_mean(center, weights, differences);
}

SPS_INLINE Vec3<float> depth_normal(const DepthImage& image, std::int32_t u, std::int32_t v, std::int32_t step_px,
                                    float max_jump) {
  if (!cross_in_image(image, u, v, step_px)) return {0.0f, 0.0f, 0.0f};
  const DepthCross z{smoothed_depth(image, u, v), smoothed_depth(image, u - step_px, v),
                     smoothed_depth(image, u + step_px, v), smoothed_depth(image, u, v - step_px),
                     smoothed_depth(image, u, v + step_px)};
  return normal_of_cross(image.camera, static_cast<float>(u), static_cast<float>(v), static_cast<float>(step_px),
                         max_jump, z);
}

}  // namespace spslam
