// The maths of finding what moves. In float64, so that CPU and CUDA decide alike.
#pragma once

#include <cmath>
#include <cstdint>

#include "core/macros.h"
#include "kernels/covisibility.h"
#include "spslam/moving_objects.h"

namespace spslam {

// What earlier frames say of a cell: they saw something behind it, they saw its surface, it shows what was behind
// surface that is gone.
enum CellEvidence : std::uint32_t { kFree = 1u, kSame = 2u, kGone = 4u };

SPS_INLINE double depth_margin(const DepthGrids& grids, double z) {
  const double noise = static_cast<double>(grids.noise[0]) + static_cast<double>(grids.noise[1]) * z * z * z * z;
  return grids.margin + grids.turn * z + grids.deviations * std::sqrt(noise);
}

// Scratch of find_moving_cells. Grid 0 is the frame's, grid 1 + i that of the i-th earlier one.
struct MovingWorkspace {
  std::uint32_t* evidence;  // [cells]
  std::uint16_t* nearest;   // [1 + num_earlier, cells] least known depth in a cell and those around it, 0 where none
  std::uint16_t* depth;     // [cells] of the frame
  std::uint8_t* moving;     // [cells]
};
SPS_INLINE MovingWorkspace moving_workspace(const DepthGrids& grids, void* memory) {
  const std::int64_t num_cells = grids.rows * grids.columns;
  std::uint32_t* evidence = static_cast<std::uint32_t*>(memory);
  std::uint16_t* nearest = reinterpret_cast<std::uint16_t*>(evidence + num_cells);
  std::uint16_t* depth = nearest + (1 + grids.num_earlier) * num_cells;
  return {evidence, nearest, depth, reinterpret_cast<std::uint8_t*>(depth + num_cells)};
}

// Depth of a cell of the frame; the cells of an earlier one.
SPS_INLINE std::uint16_t frame_cell(const DepthGrids& grids, std::int64_t row, std::int64_t column) {
  return grids.depth[row * grids.step * grids.width + column * grids.step];
}
SPS_INLINE const std::uint16_t* earlier_cells(const DepthGrids& grids, std::int64_t i) {
  return grids.earlier + grids.slots[i] * grids.rows * grids.columns;
}

// The nearer of two depths, of which 0 is unknown: less 1 that is the largest.
SPS_INLINE std::uint16_t nearer(std::uint16_t a, std::uint16_t b) {
  const std::uint16_t x = static_cast<std::uint16_t>(a - 1), y = static_cast<std::uint16_t>(b - 1);
  return static_cast<std::uint16_t>((x < y ? x : y) + 1);
}
SPS_INLINE std::uint16_t nearest_of(std::uint16_t a, std::uint16_t b, std::uint16_t c) {
  return nearer(a, nearer(b, c));
}

// The motion that takes points in the axes of a frame at pose `from` into those of one at pose `to`.
SPS_INLINE Pose<double> motion_between(const Pose<double>& from, const Pose<double>& to) {
  const double *a = to.rotation.m, *b = from.rotation.m;
  Pose<double> motion{{}, in_frame(to, from.translation)};
  for (int r = 0; r < 3; ++r) {
    for (int c = 0; c < 3; ++c) motion.rotation.m[3 * r + c] = a[r] * b[c] + a[3 + r] * b[3 + c] + a[6 + r] * b[6 + c];
  }
  return motion;
}

// The cell in which a frame sees the surface of a cell of another one, of depth z (m, 0 where unknown), by the motion
// to that frame, and the depth there; cell -1 where it does not see it.
struct SeenCell {
  std::int32_t cell;
  double depth;
};
SPS_INLINE SeenCell seen_cell(const DepthGrids& grids, const Pose<double>& motion, std::int64_t row,
                              std::int64_t column, double z) {
  const Intrinsics& k = grids.intrinsics;
  const double step = static_cast<double>(grids.step);
  const double u = static_cast<double>(column) * step, v = static_cast<double>(row) * step;
  const Vec3<double> own{(u - k.cx) / k.fx * z, (v - k.cy) / k.fy * z, z};
  const Vec3<double> seen = motion.rotation * own + motion.translation;
  const double scale = 1.0 / (seen.z * step);
  const double c = std::floor(seen.x * scale * k.fx + k.cx / step + 0.5);
  const double r = std::floor(seen.y * scale * k.fy + k.cy / step + 0.5);
  const bool is_seen = (z > 0.0) & (seen.z > kMinPointDepth) & (c >= 0.0) & (c < static_cast<double>(grids.columns)) &
                       (r >= 0.0) & (r < static_cast<double>(grids.rows));
  const double cell = is_seen ? r * static_cast<double>(grids.columns) + c : -1.0;
  return {static_cast<std::int32_t>(cell), seen.z};
}

// What an earlier frame says of a cell of the frame, by where it sees its surface, the depths that it measured there
// and around, and how much depths there may differ: kFree, kSame or 0.
SPS_INLINE std::uint32_t earlier_evidence(const DepthGrids& grids, double seen, std::uint16_t measured,
                                          std::uint16_t nearest, double margin) {
  const double there = grids.unit * measured, around = grids.unit * nearest;
  const std::uint32_t same = measured != 0 && std::fabs(seen - there) < margin ? kSame : 0u;
  return nearest != 0 && seen < around - margin ? same | kFree : same;
}

// Whether the frame sees through surface of an earlier one, at `seen`, by the nearest depth around.
SPS_INLINE bool is_gone(const DepthGrids& grids, double seen, std::uint16_t nearest) {
  const double around = grids.unit * nearest;
  return nearest != 0 && seen < around - depth_margin(grids, around);
}

// Whether the evidence says that a cell moves.
SPS_INLINE bool seems_moving(std::uint32_t evidence) {
  return (evidence & kFree) || (evidence & (kGone | kSame)) == kGone;
}

// Whether a cell seems to move, as do more than half of it and those around it.
SPS_INLINE bool is_moving(const DepthGrids& grids, const std::uint32_t* evidence, const std::uint16_t* depth,
                          std::int64_t cell) {
  if (!seems_moving(evidence[cell]) || depth[cell] == 0) return false;
  const std::int64_t row = cell / grids.columns, column = cell % grids.columns;
  int moving = 0, all = 0;
  for (std::int64_t r = row > 0 ? row - 1 : 0; r <= row + 1 && r < grids.rows; ++r) {
    for (std::int64_t c = column > 0 ? column - 1 : 0; c <= column + 1 && c < grids.columns; ++c) {
      const std::int64_t other = r * grids.columns + c;
      moving += seems_moving(evidence[other]) && depth[other] != 0;
      ++all;
    }
  }
  return 2 * moving > all;
}

// Whether a cell or one around it is marked.
SPS_INLINE bool is_marked_around(const DepthGrids& grids, const std::uint8_t* marks, std::int64_t cell) {
  const std::int64_t row = cell / grids.columns, column = cell % grids.columns;
  for (std::int64_t r = row > 0 ? row - 1 : 0; r <= row + 1 && r < grids.rows; ++r) {
    for (std::int64_t c = column > 0 ? column - 1 : 0; c <= column + 1 && c < grids.columns; ++c) {
      if (marks[r * grids.columns + c]) return true;
    }
  }
  return false;
}

// Whether a pixel of the depth image lies in a marked cell; a cell's own pixel is its middle.
SPS_INLINE bool is_in_marked(const FrameSamples& samples, const std::uint8_t* cells, std::int64_t row,
                             std::int64_t column) {
  const std::int64_t r = (row + samples.step / 2) / samples.step, c = (column + samples.step / 2) / samples.step;
  return cells[(r < samples.rows ? r : samples.rows - 1) * samples.columns +
               (c < samples.columns ? c : samples.columns - 1)] != 0;
}
SPS_INLINE bool is_record_marked(const FrameSamples& samples, const std::uint8_t* cells, std::int64_t i) {
  const std::uint32_t place = static_cast<std::uint32_t>(samples.records[kPixelWords * i]);
  return is_in_marked(samples, cells, static_cast<std::int64_t>(place >> 16) / samples.image_step,
                      static_cast<std::int64_t>(place & 0xFFFFu) / samples.image_step);
}

// The same of the pixel that a cell of the thumbnail holds the depth of.
SPS_INLINE bool is_thumbnail_marked(const FrameSamples& samples, const std::uint8_t* cells, std::int64_t i) {
  const std::int64_t half = samples.thumbnail_step / 2;
  const std::int64_t row = i / samples.thumbnail_columns, column = i % samples.thumbnail_columns;
  return is_in_marked(samples, cells, (row * samples.thumbnail_step + half) / samples.image_step,
                      (column * samples.thumbnail_step + half) / samples.image_step);
}

// Whether pixels are to be left out, by the shares; `counts` of find_moving_cells.
SPS_INLINE bool leaves_out(const FrameSamples& samples, const std::int32_t* counts, std::int64_t kept) {
  const double moving = counts[0], all = counts[1];
  return moving > samples.least * all && moving < samples.most * all && kept >= samples.fewest;
}

// Copies a record and its normal.
SPS_INLINE void copy_sample(const FrameSamples& samples, std::int64_t from, std::int64_t to, std::int32_t* records,
                            float* normals) {
  for (int k = 0; k < kPixelWords; ++k) records[kPixelWords * to + k] = samples.records[kPixelWords * from + k];
  for (int k = 0; k < 3; ++k) normals[3 * to + k] = samples.normals[3 * from + k];
}

}  // namespace spslam
