// What sample_pixels takes of single pixels.
#pragma once

#include <cstdint>

#include "core/half.h"
#include "core/macros.h"
#include "kernels/depth_normal.h"
#include "kernels/pixel_record.h"
#include "spslam/pixel_sampling.h"

namespace spslam {

// A depth (m) if it is known and in the range, or 0.
SPS_INLINE float usable_depth(float z, float low, float high) {
  const float known = valid_depth(z);
  return (known >= low) & (known <= high) ? known : 0.0f;
}

// A usable depth as a number of the depth image; 0 where it is too large.
SPS_INLINE std::uint16_t depth_image_number(float depth, float per_unit) {
  const float units = depth * per_unit + 0.5f;
  return static_cast<std::uint16_t>(units < 65536.0f ? static_cast<std::int32_t>(units) : 0);
}

// The camera as normals take it.
SPS_INLINE Intrinsics camera_of(const RgbdImage& image) {
  return {static_cast<float>(image.fx), static_cast<float>(image.fy), static_cast<float>(image.cx),
          static_cast<float>(image.cy)};
}

// Writes the record of pixel (u, v) of an image, which has that depth and normal.
SPS_INLINE void write_record(const RgbdImage& image, std::int32_t u, std::int32_t v, float depth, const float* normal,
                             std::int32_t* record) {
  const std::uint8_t* color = image.color + 3 * (static_cast<std::int64_t>(v) * image.width + u);
  pack_pixel(u, v, depth, color, normal, image.fx, image.fy, image.cx, image.cy, record);
}

}  // namespace spslam
