// The brightness that frames have seen of surface, and what an image shows there.
#pragma once

#include <cstdint>

#include "core/device.h"
#include "spslam/types/camera.h"

namespace spslam {

// Pixels of frames, of which the first num_points of each count, and the cells of the image that they lie in.
struct SeenPixels {
  const std::int32_t* records;  // [num_frames, num_records, 3]
  const float* poses;           // [num_frames, 7]
  std::int64_t num_frames, num_records, num_points;
  Intrinsics intrinsics;        // of the image, px
  std::int64_t columns, rows;   // of the image
  std::int64_t cells_in_a_row;  // and in a column
};

// A frame's small images.
struct ShownImages {
  const std::uint16_t* depth;     // [rows, columns], 0 where unknown
  const std::uint8_t* intensity;  // [rows, columns], in 1/255
  std::int64_t rows, columns;
  Intrinsics intrinsics;  // of these images, px
  double unit_m;          // of depth
  double tolerance;       // as a share of its depth, by which a point on the surface shown may be off
};

// Bytes that sum_brightness needs.
template <class Device>
std::int64_t brightness_workspace_size(Device device, const SeenPixels& seen, std::int64_t num_rows);

// sums [5] over the points of the frames `rows` [num_rows] that images at `pose` [7] show: of 1, b, and of m m, b b and
// m b, where m is the brightness in [0, 1] that the frame has seen and b what the image shows, bilinearly, and the
// products are of deviations from the means of each cell of each frame. A row out of range has no points.
template <class Device>
void sum_brightness(Device device, const SeenPixels& seen, const std::int64_t* rows, std::int64_t num_rows,
                    const ShownImages& shown, const float* pose, void* workspace, double* sums);

}  // namespace spslam
