// What moves before a camera: surface where earlier frames saw free space, and what has come to light behind surface
// that is gone.
#pragma once

#include <cstdint>

#include "core/device.h"
#include "spslam/types/camera.h"

namespace spslam {

constexpr int kMaxEarlierGrids = 16;

// Depth images of a frame and of earlier ones, looked at in cells: every step-th pixel of every step-th row.
struct DepthGrids {
  const std::uint16_t* depth;    // [height, width] of the frame, in `unit`; 0 where unknown
  const float* pose;             // [7] of the frame
  const std::uint16_t* earlier;  // [slots, rows, columns] cells of earlier frames
  const float* poses;            // [frames, 7]
  const float* noise;            // [2] a^2 (m^2) and c^2 (1/m^2) of the variance of a depth z, a^2 + c^2 z^4
  std::int64_t height, width, step, rows, columns;
  Intrinsics intrinsics;  // of the depth images, px
  double unit;            // m
  // Depths differ if they do by more than margin + turn z + deviations sigma(z), m.
  double margin, turn, deviations;
  std::int64_t num_earlier;
  std::int32_t slots[kMaxEarlierGrids], frames[kMaxEarlierGrids];  // of each earlier frame: its cells, and its pose
};

// Bytes of find_moving_cells's scratch, aligned to four.
inline std::int64_t moving_cells_workspace_size(const DepthGrids& grids) {
  constexpr std::int64_t kPerGrid = sizeof(std::uint16_t);
  constexpr std::int64_t kOnce = sizeof(std::uint32_t) + sizeof(std::uint16_t) + sizeof(std::uint8_t);
  return grids.rows * grids.columns * ((1 + grids.num_earlier) * kPerGrid + kOnce);
}

// cells [rows, columns] = 1 where the frame shows what moves, and in the cells around. A cell moves if an earlier frame
// saw something clearly behind it, or if the frame sees through where an earlier one saw surface and no earlier one saw
// this cell's own; and if so do more than half of the cells around it. counts [2]: cells that move, those around not
// counted, and cells with depth.
template <class Device>
void find_moving_cells(Device device, const DepthGrids& grids, void* workspace, std::uint8_t* cells,
                       std::int32_t* counts);

// A frame's pixels, of which those in moving cells are left out.
struct FrameSamples {
  const std::int32_t* records;     // [num_records, 3]
  const float* normals;            // [num_records, 3]
  const std::uint16_t* depth;      // [height, width]
  const std::uint16_t* thumbnail;  // [thumbnail_rows, thumbnail_columns] bits of float16
  std::int64_t num_records, height, width, thumbnail_rows, thumbnail_columns;
  std::int64_t image_step, thumbnail_step;  // px of the frame between two of the depth image, of the thumbnail
  std::int64_t step, rows, columns;         // of the cells, px of the depth image
  double least, most;                       // shares of the cells with depth
  std::int64_t fewest;                      // records
};

// Copies all, with depth 0 in moving cells; the k-th record there becomes the one outside of k modulo their number. As
// it is where the share of cells that move is not between least and most, or fewer than `fewest` records are left.
// `places` [2 num_records + 1] is scratch.
template <class Device>
void leave_out_moving(Device device, const FrameSamples& samples, const std::uint8_t* cells, const std::int32_t* counts,
                      std::int32_t* places, std::int32_t* records, float* normals, std::uint16_t* depth,
                      std::uint16_t* thumbnail);

}  // namespace spslam
