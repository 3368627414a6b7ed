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

// Depth (m) of a cell of the frame, and of an earlier one; 0 where unknown.
SPS_INLINE double cell_depth(const DepthGrids& grids, std::int64_t row, std::int64_t column) {
  return grids.unit * grids.depth[row * grids.step * grids.width + column * grids.step];
}
SPS_INLINE double cell_depth(const DepthGrids& grids, std::int64_t slot, std::int64_t row, std::int64_t column) {
  return grids.unit * grids.earlier[(slot * grids.rows + row) * grids.columns + column];
}

// Nearest depth in a cell and those around it; 0 where none is known. `depth` returns that of a row and column.
template <class Depth>
SPS_INLINE double nearest_around(const DepthGrids& grids, std::int64_t row, std::int64_t column, const Depth& depth) {
  double nearest = 0.0;
  for (std::int64_t r = row > 0 ? row - 1 : 0; r <= row + 1 && r < grids.rows; ++r) {
    for (std::int64_t c = column > 0 ? column - 1 : 0; c <= column + 1 && c < grids.columns; ++c) {
      const double z = depth(r, c);
      if (z > 0.0 && (nearest == 0.0 || z < nearest)) nearest = z;
    }
  }
  return nearest;
}

// World point of a cell of depth z in a frame at a pose.
SPS_INLINE Vec3<double> cell_point(const DepthGrids& grids, const Pose<double>& pose, std::int64_t row,
                                   std::int64_t column, double z) {
  const Intrinsics& k = grids.intrinsics;
  const double u = static_cast<double>(column * grids.step), v = static_cast<double>(row * grids.step);
  return pose.rotation * Vec3<double>{(u - k.cx) / k.fx * z, (v - k.cy) / k.fy * z, z} + pose.translation;
}

// Cell in which a frame at a pose sees a world point, and the point's depth there; none outside of the image.
struct SeenCell {
  bool is_seen;
  std::int64_t row, column;
  double depth;
};
SPS_INLINE SeenCell seen_cell(const DepthGrids& grids, const Pose<double>& pose, const Vec3<double>& point) {
  const auto [x, y, z] = in_frame(pose, point);
  if (!(z > kMinPointDepth)) return {false, 0, 0, 0.0};
  const Intrinsics& k = grids.intrinsics;
  const double step = static_cast<double>(grids.step);
  const double column = std::floor((x / z * k.fx + k.cx) / step + 0.5);
  const double row = std::floor((y / z * k.fy + k.cy) / step + 0.5);
  const bool is_seen = column >= 0.0 && column < static_cast<double>(grids.columns) && row >= 0.0 &&
                       row < static_cast<double>(grids.rows);
  if (!is_seen) return {false, 0, 0, 0.0};
  return {true, static_cast<std::int64_t>(row), static_cast<std::int64_t>(column), z};
}

// What the i-th earlier frame, at `then`, says of a cell of the frame, at `now`: kFree, kSame or 0.
SPS_INLINE std::uint32_t earlier_evidence(const DepthGrids& grids, std::int64_t i, const Pose<double>& then,
                                          const Pose<double>& now, std::int64_t row, std::int64_t column) {
  const double own = cell_depth(grids, row, column);
  if (!(own > 0.0)) return 0u;
  const SeenCell seen = seen_cell(grids, then, cell_point(grids, now, row, column, own));
  if (!seen.is_seen) return 0u;
  const std::int64_t slot = grids.slots[i];
  const double margin = depth_margin(grids, seen.depth);
  const double measured = cell_depth(grids, slot, seen.row, seen.column);
  std::uint32_t evidence = measured > 0.0 && std::fabs(seen.depth - measured) < margin ? kSame : 0u;
  const double nearest = nearest_around(grids, seen.row, seen.column,
                                        [&](std::int64_t r, std::int64_t c) { return cell_depth(grids, slot, r, c); });
  if (nearest > 0.0 && seen.depth < nearest - margin) evidence |= kFree;
  return evidence;
}

// The cell of the frame, at `now`, that sees through where a cell of the i-th earlier frame, at `then`, saw surface; -1
// where none does.
SPS_INLINE std::int64_t gone_before(const DepthGrids& grids, std::int64_t i, const Pose<double>& then,
                                    const Pose<double>& now, std::int64_t row, std::int64_t column) {
  const double own = cell_depth(grids, grids.slots[i], row, column);
  if (!(own > 0.0)) return -1;
  const SeenCell seen = seen_cell(grids, now, cell_point(grids, then, row, column, own));
  if (!seen.is_seen) return -1;
  const double nearest = nearest_around(grids, seen.row, seen.column,
                                        [&](std::int64_t r, std::int64_t c) { return cell_depth(grids, r, c); });
  const bool is_gone = nearest > 0.0 && seen.depth < nearest - depth_margin(grids, nearest);
  return is_gone ? seen.row * grids.columns + seen.column : -1;
}

// Whether the evidence says that a cell moves.
SPS_INLINE bool seems_moving(std::uint32_t evidence) {
  return (evidence & kFree) || (evidence & (kGone | kSame)) == kGone;
}

// Whether a cell seems to move, as do more than half of it and those around it.
SPS_INLINE bool is_moving(const DepthGrids& grids, const std::uint32_t* evidence, std::int64_t cell) {
  const std::int64_t row = cell / grids.columns, column = cell % grids.columns;
  if (!seems_moving(evidence[cell]) || !(cell_depth(grids, row, column) > 0.0)) return false;
  int moving = 0, all = 0;
  for (std::int64_t r = row > 0 ? row - 1 : 0; r <= row + 1 && r < grids.rows; ++r) {
    for (std::int64_t c = column > 0 ? column - 1 : 0; c <= column + 1 && c < grids.columns; ++c) {
      moving += seems_moving(evidence[r * grids.columns + c]) && cell_depth(grids, r, c) > 0.0;
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
