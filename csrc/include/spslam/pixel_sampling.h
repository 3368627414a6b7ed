// The pixels of a frame that tracking and mapping work on.
#pragma once

#include <cstdint>

#include "core/device.h"
#include "core/philox.h"
#include "spslam/types/camera.h"

namespace spslam {

// A frame's depth and color images, aligned with each other, and its camera (px).
struct RgbdImage {
  const float* depth;         // [height, width], m; 0, negative and not finite are invalid
  const std::uint8_t* color;  // [height, width, 3]
  std::int32_t width, height;
  double fx, fy, cx, cy;
};

struct PixelSampling {
  std::int64_t count;             // pixels to draw
  float min_depth, max_depth;     // m; depths outside, 0 and not finite ones are not drawn
  std::int32_t step_px;           // of the normals' differences
  float max_jump;                 // of depth beside a normal, as a share
  std::int32_t thumbnail_step;    // px; the first pixel of the depth thumbnail lies at half of it
  std::int32_t depth_image_step;  // px; the first pixel of the small images lies at 0; 0: no small images
  float depth_image_unit;         // m, of its depth
  bool shared;                    // whether several threads of the CPU share the frame
};

// Where the results go.
struct SampledPixels {
  std::int32_t* records;           // [count, 3], see kernels/pixel_record.h
  float* normals;                  // [count, 3], camera axes, towards the camera; 0 where unknown
  std::uint16_t* depth_thumbnail;  // [thumbnail_size(height), thumbnail_size(width)] float16 m, 0 where invalid
  std::uint16_t* depth_image;      // [depth_image_size(height), depth_image_size(width)] units, 0: invalid or too far
  std::uint8_t* intensity_image;   // of the same size: intensity in 1/255
};

constexpr std::int32_t thumbnail_size(std::int32_t size, std::int32_t step) {
  return size > step / 2 ? (size - step / 2 + step - 1) / step : 0;
}

constexpr std::int32_t depth_image_size(std::int32_t size, std::int32_t step) {
  return step > 0 ? (size + step - 1) / step : 0;
}

// Bytes of scratch memory that sample_pixels needs.
template <class Device>
std::int64_t sample_pixels_workspace_bytes(Device device, std::int32_t width, std::int32_t height);

// Draws pixels among those of valid depth, with replacement: the i-th takes element i of the key's draws. Returns how
// many pixels were valid, for which it waits; where none was, records and normals are 0. Devices differ by rounding in
// normals, and so in a record's foreshortening. On the CPU a frame's own thread does it, unless it is shared.
template <class Device>
std::int64_t sample_pixels(Device device, const RgbdImage& image, PhiloxKey key, const PixelSampling& sampling,
                           void* workspace, const SampledPixels& out);

// Surface points [n, 3] (m) and normals [n, 3] in the world of pixels' records [n, 3] and normals [n, 3] in the camera
// at `pose`: seven numbers, unit quaternion (w, x, y, z) and translation of T_world_camera, on the device.
template <class Device>
void unproject_pixels(Device device, const std::int32_t* records, const float* camera_normals, std::int64_t n,
                      const float* pose, const Intrinsics& intrinsics, float* points, float* normals);

}  // namespace spslam
