#include "spslam/moving_objects.h"

#include <algorithm>

#include "core/for_each.h"
#include "core/parallel.h"
#include "kernels/moving_objects.h"

namespace spslam {
namespace {

constexpr std::int64_t kRowGrain = 4;  // rows of cells, of one earlier frame

}  // namespace

template <>
std::int64_t moving_cells_workspace_size<Cpu>(Cpu, const DepthGrids& grids) {
  return grids.rows * grids.columns * static_cast<std::int64_t>(sizeof(std::uint32_t) + 1);
}

template <>
void find_moving_cells<Cpu>(Cpu device, const DepthGrids& grids, void* workspace, std::uint8_t* cells,
                            std::int32_t* counts) {
  const std::int64_t num_cells = grids.rows * grids.columns;
  std::uint32_t* evidence = static_cast<std::uint32_t*>(workspace);
  std::uint8_t* moving = reinterpret_cast<std::uint8_t*>(evidence + num_cells);
  std::fill_n(evidence, num_cells, 0u);
  const Pose<double> now = load_frame_pose(grids.pose);
  parallel_for(grids.num_earlier * grids.rows, kRowGrain, [&](std::int64_t begin, std::int64_t end) {
    for (std::int64_t line = begin; line < end; ++line) {
      const std::int64_t i = line / grids.rows, row = line % grids.rows;
      const Pose<double> then = load_frame_pose(grids.poses + kPoseSize * grids.frames[i]);
      for (std::int64_t column = 0; column < grids.columns; ++column) {
        const std::uint32_t found = earlier_evidence(grids, i, then, now, row, column);
        if (found) __atomic_fetch_or(evidence + row * grids.columns + column, found, __ATOMIC_RELAXED);
        const std::int64_t cell = gone_before(grids, i, then, now, row, column);
        if (cell >= 0) __atomic_fetch_or(evidence + cell, std::uint32_t{kGone}, __ATOMIC_RELAXED);
      }
    }
  });
  counts[0] = counts[1] = 0;
  for (std::int64_t cell = 0; cell < num_cells; ++cell) {
    moving[cell] = is_moving(grids, evidence, cell);
    counts[0] += moving[cell];
    counts[1] += cell_depth(grids, cell / grids.columns, cell % grids.columns) > 0.0;
  }
  for_each(device, num_cells, [&](std::int64_t cell) { cells[cell] = is_marked_around(grids, moving, cell); });
}

template <>
void leave_out_moving<Cpu>(Cpu device, const FrameSamples& samples, const std::uint8_t* cells,
                           const std::int32_t* counts, std::int32_t* places, std::int32_t* records, float* normals,
                           std::uint16_t* depth, std::uint16_t* thumbnail) {
  std::int64_t kept = 0;
  for (std::int64_t i = 0; i < samples.num_records; ++i) {
    if (!is_record_marked(samples, cells, i)) places[kept++] = static_cast<std::int32_t>(i);
  }
  const bool leaves = leaves_out(samples, counts, kept);
  std::int64_t next_kept = 0, left_out = 0;
  for (std::int64_t i = 0; i < samples.num_records; ++i) {
    const bool is_kept = next_kept < kept && places[next_kept] == i;
    next_kept += is_kept;
    const bool is_replaced = leaves && !is_kept;
    copy_sample(samples, is_replaced ? places[left_out++ % kept] : i, i, records, normals);
  }
  for_each(device, samples.height * samples.width, [&](std::int64_t i) {
    const bool is_out = leaves && is_in_marked(samples, cells, i / samples.width, i % samples.width);
    depth[i] = is_out ? std::uint16_t{0} : samples.depth[i];
  });
  for_each(device, samples.thumbnail_rows * samples.thumbnail_columns, [&](std::int64_t i) {
    thumbnail[i] = leaves && is_thumbnail_marked(samples, cells, i) ? std::uint16_t{0} : samples.thumbnail[i];
  });
}

}  // namespace spslam
