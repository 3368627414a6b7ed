// The maths of comparing a frame with surface that others have seen.
// In float64, as whether a frame sees a point (kernels/covisibility.h): CPU and CUDA count the same.
#pragma once

#include <cmath>
#include <cstdint>

#include "core/macros.h"
#include "kernels/covisibility.h"
#include "spslam/known_surface.h"

namespace spslam {

constexpr std::int32_t kNoRecord = 0x7fffffff;

// What a frame's count is of: points seen, looked through, and hidden by what is nearer.
enum SurfaceCount { kSeen, kThrough, kHidden, kSurfaceCounts };

struct ComparedPoint {
  int kind;           // a SurfaceCount; kSurfaceCounts where it says nothing
  std::int32_t cell;  // of the grid, where it says something
};

SPS_INLINE bool has_normal(const float* normal) {
  return normal[0] != 0.0f || normal[1] != 0.0f || normal[2] != 0.0f;
}

// Cell of the grid that a record's pixel lies in; -1 where the image is larger than the grid.
SPS_INLINE std::int32_t cell_of(const ComparedFrame& frame, const std::int32_t* record) {
  const std::uint32_t place = static_cast<std::uint32_t>(record[0]);
  const std::int64_t row = static_cast<std::int64_t>(place >> 16) / frame.step;
  const std::int64_t column = static_cast<std::int64_t>(place & 0xFFFFu) / frame.step;
  const bool inside = row < frame.rows && column < frame.columns;
  return inside ? static_cast<std::int32_t>(row * frame.columns + column) : -1;
}

// A point of thumbnail cell `place` of the frame in `row`, at `pose`, compared with the frame at `own`, of whose grid
// the cells have the records `first`.
SPS_INLINE ComparedPoint compared_point(const FrameThumbnails& frames, std::int64_t row, const Pose<double>& pose,
                                        std::int64_t place, const ComparedFrame& frame, const Pose<double>& own,
                                        const std::int32_t* first, const SurfaceTolerance& tolerance) {
  constexpr ComparedPoint kNothing{kSurfaceCounts, 0};
  const Intrinsics& k = frames.intrinsics;
  const double depth = half_to_float(frames.depth_thumbnails[row * frames.rows * frames.columns + place]);
  if (!(depth > 0.0)) return kNothing;
  const double u = static_cast<double>(place % frames.columns * frames.step + frames.step / 2);
  const double v = static_cast<double>(place / frames.columns * frames.step + frames.step / 2);
  const Vec3<double> local{(u - k.cx) / k.fx * depth, (v - k.cy) / k.fy * depth, depth};
  const auto [x, y, z] = in_frame(own, pose.rotation * local + pose.translation);
  if (!(z > kMinPointDepth)) return kNothing;
  const double step = static_cast<double>(frame.step);
  const double column = std::floor((x / z * k.fx + k.cx + 0.5) / step);
  const double line = std::floor((y / z * k.fy + k.cy + 0.5) / step);
  if (!(column >= 0.0 && column < static_cast<double>(frame.columns) && line >= 0.0 &&
        line < static_cast<double>(frame.rows))) {
    return kNothing;
  }
  const std::int32_t cell =
      static_cast<std::int32_t>(line) * static_cast<std::int32_t>(frame.columns) + static_cast<std::int32_t>(column);
  if (first[cell] == kNoRecord) return kNothing;
  const double seen = unpack_pixel(frame.records + kPixelWords * static_cast<std::int64_t>(first[cell])).depth;
  if (!(seen > 0.0)) return kNothing;
  const double behind = (seen - z) / (tolerance.meters + tolerance.share * z);
  if (std::fabs(behind) < 1.0) return {kSeen, cell};
  if (behind > tolerance.clear) return {kThrough, cell};
  return behind < -tolerance.clear ? ComparedPoint{kHidden, cell} : kNothing;
}

// Whether a cell of the grid, or one beside it, is marked.
SPS_INLINE bool is_marked_near(const ComparedFrame& frame, const std::uint8_t* marks, std::int32_t cell) {
  const std::int64_t row = cell / frame.columns, column = cell % frame.columns;
  for (std::int64_t r = row - 1; r <= row + 1; ++r) {
    for (std::int64_t c = column - 1; c <= column + 1; ++c) {
      if (r >= 0 && r < frame.rows && c >= 0 && c < frame.columns && marks[r * frame.columns + c]) return true;
    }
  }
  return false;
}

// How many of the rows share more surface than the i-th, or as much and come before it. Counts are [num_rows, 3].
SPS_INLINE std::int64_t rank_of(const std::int32_t* counts, std::int64_t i, std::int64_t num_rows) {
  const std::int32_t* own = counts + kSurfaceCounts * i;
  std::int64_t better = 0;
  for (std::int64_t j = 0; j < num_rows; ++j) {
    const std::int32_t* other = counts + kSurfaceCounts * j;
    const std::int32_t more = other[kSeen] + other[kThrough] - own[kSeen] - own[kThrough];
    better += more > 0 || (more == 0 && j < i);
  }
  return better;
}

// Parts of the workspace.
struct KnownSurfaceSpace {
  std::int32_t* first;   // [cells], number of the record that counts
  std::int32_t* counts;  // [num_rows, 3]
  std::int32_t* hidden;  // [num_rows, points], cell that hides the point; -1 where nothing does
  std::uint8_t* marks;   // [cells], whether a point lies on the surface there
  std::int64_t num_cells, num_points;

  KnownSurfaceSpace(void* workspace, const FrameThumbnails& frames, const ComparedFrame& frame, std::int64_t num_rows)
      : num_cells(frame.rows * frame.columns), num_points(frames.rows * frames.columns) {
    first = static_cast<std::int32_t*>(workspace);
    counts = first + num_cells;
    hidden = counts + kSurfaceCounts * num_rows;
    marks = reinterpret_cast<std::uint8_t*>(hidden + num_rows * num_points);
  }

  static std::int64_t size(const FrameThumbnails& frames, const ComparedFrame& frame, std::int64_t num_rows) {
    const std::int64_t cells = frame.rows * frame.columns, points = frames.rows * frames.columns;
    const std::int64_t numbers = cells + num_rows * (kSurfaceCounts + points);
    return numbers * static_cast<std::int64_t>(sizeof(std::int32_t)) + cells;
  }
};

}  // namespace spslam
