// What a frame at a pose would see of surface that other frames have seen.
#pragma once

#include <cstdint>

#include "core/device.h"
#include "spslam/covisibility.h"

namespace spslam {

// A frame that is compared: of its pixels the first one with a normal in each cell of a grid over the image counts.
struct ComparedFrame {
  const std::int32_t* records;  // [num_records, 3]
  const float* normals;         // [num_records, 3], 0 where unknown
  std::int64_t num_records;
  const float* pose;                 // [7]
  std::int64_t step, rows, columns;  // of the grid: side of a cell, px, and number of cells
};

// A depth is that of known surface if they differ by less than the tolerance, that of its distance z (m) being
// meters + share * z; it is clearly behind or before it from so many tolerances on.
struct SurfaceTolerance {
  double meters, share, clear;
};

// Bytes that count_known_surface needs.
template <class Device>
std::int64_t known_surface_workspace_size(Device device, const FrameThumbnails& frames, const ComparedFrame& frame,
                                          std::int64_t num_rows);

// Counts the points of the depth thumbnails of the frames `rows` [num_rows]: those on the surface that the compared
// frame sees, those it looks through, and those that something nearer hides from it which is not itself known surface
// there or in a cell beside. counts [3]: the sums over the num_best rows that share most surface with it (the first two
// counts), of which best [num_best] are the places in `rows`, the best first and of equal ones the first; num_best is
// at most num_rows. A row out of range has no points.
template <class Device>
void count_known_surface(Device device, const FrameThumbnails& frames, const ComparedFrame& frame,
                         const SurfaceTolerance& tolerance, const std::int64_t* rows, std::int64_t num_rows,
                         std::int64_t num_best, void* workspace, std::int64_t* counts, std::int64_t* best);

}  // namespace spslam
