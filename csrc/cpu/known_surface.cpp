#include "spslam/known_surface.h"

#include <algorithm>

#include "core/parallel.h"
#include "kernels/known_surface.h"

namespace spslam {
namespace {

constexpr std::int64_t kRowGrain = 2;

void find_first_records(const ComparedFrame& frame, const KnownSurfaceSpace& space) {
  std::fill_n(space.first, space.num_cells, kNoRecord);
  for (std::int64_t i = frame.num_records - 1; i >= 0; --i) {
    const std::int32_t cell = cell_of(frame, frame.records + kPixelWords * i);
    if (cell >= 0 && has_normal(frame.normals + 3 * i)) space.first[cell] = static_cast<std::int32_t>(i);
  }
}

}  // namespace

template <>
std::int64_t known_surface_workspace_size<Cpu>(Cpu, const FrameThumbnails& frames, const ComparedFrame& frame,
                                               std::int64_t num_rows) {
  return KnownSurfaceSpace::size(frames, frame, num_rows);
}

template <>
void count_known_surface<Cpu>(Cpu, const FrameThumbnails& frames, const ComparedFrame& frame,
                              const SurfaceTolerance& tolerance, const std::int64_t* rows, std::int64_t num_rows,
                              std::int64_t num_best, void* workspace, std::int64_t* counts, std::int64_t* best) {
  const KnownSurfaceSpace space(workspace, frames, frame, num_rows);
  const Pose<double> own = load_frame_pose(frame.pose);
  find_first_records(frame, space);
  std::fill_n(space.marks, space.num_cells, std::uint8_t{0});
  parallel_for(num_rows, kRowGrain, [&](std::int64_t begin, std::int64_t end) {
    for (std::int64_t i = begin; i < end; ++i) {
      std::int32_t* own_counts = space.counts + kSurfaceCounts * i;
      std::int32_t* hidden = space.hidden + space.num_points * i;
      std::fill_n(own_counts, kSurfaceCounts, 0);
      std::fill_n(hidden, space.num_points, -1);
      if (!is_frame(frames, rows[i])) continue;
      const Pose<double> pose = load_frame_pose(frames.poses + kPoseSize * rows[i]);
      for (std::int64_t place = 0; place < space.num_points; ++place) {
        const ComparedPoint point = compared_point(frames, rows[i], pose, place, frame, own, space.first, tolerance);
        if (point.kind == kHidden) {
          hidden[place] = point.cell;
        } else if (point.kind != kSurfaceCounts) {
          ++own_counts[point.kind];
          // Several threads may write the same.
          if (point.kind == kSeen) __atomic_store_n(space.marks + point.cell, std::uint8_t{1}, __ATOMIC_RELAXED);
        }
      }
    }
  });
  parallel_for(num_rows, kRowGrain, [&](std::int64_t begin, std::int64_t end) {
    for (std::int64_t i = begin; i < end; ++i) {
      const std::int32_t* hidden = space.hidden + space.num_points * i;
      for (std::int64_t place = 0; place < space.num_points; ++place) {
        const bool is_hidden = hidden[place] >= 0 && !is_marked_near(frame, space.marks, hidden[place]);
        space.counts[kSurfaceCounts * i + kHidden] += is_hidden;
      }
    }
  });
  std::fill_n(counts, kSurfaceCounts, std::int64_t{0});
  for (std::int64_t i = 0; i < num_rows; ++i) {
    const std::int64_t rank = rank_of(space.counts, i, num_rows);
    if (rank >= num_best) continue;
    best[rank] = i;
    for (int kind = 0; kind < kSurfaceCounts; ++kind) counts[kind] += space.counts[kSurfaceCounts * i + kind];
  }
}

}  // namespace spslam
