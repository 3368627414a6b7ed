#include "spslam/moving_objects.h"

#include <algorithm>

#include "core/for_each.h"
#include "core/parallel.h"
#include "kernels/moving_objects.h"

namespace spslam {
namespace {

constexpr std::int64_t kRowGrain = 8;  // rows of cells, of one earlier frame
constexpr std::int64_t kLanes = 64;    // cells of a row that are looked at together

// nearest [columns] of a row of cells: the rows above and below first, then the columns beside.
void nearest_in_row(const std::uint16_t* above, const std::uint16_t* here, const std::uint16_t* below,
                    std::int64_t columns, std::uint16_t* nearest) {
  for (std::int64_t begin = 0; begin < columns; begin += kLanes) {
    const std::int64_t end = std::min(begin + kLanes, columns);
    // With one column more on either side, of unknown depth beyond the border.
    std::uint16_t lines[kLanes + 2];
    lines[0] = lines[end - begin + 1] = 0;
    const std::int64_t from = begin > 0 ? begin - 1 : 0, to = end < columns ? end + 1 : columns;
    SPS_SIMD
    for (std::int64_t c = from; c < to; ++c) lines[c - begin + 1] = nearest_of(above[c], here[c], below[c]);
    SPS_SIMD
    for (std::int64_t c = 0; c < end - begin; ++c) {
      nearest[begin + c] = nearest_of(lines[c], lines[c + 1], lines[c + 2]);
    }
  }
}

// nearest [rows, columns] of one grid.
void nearest_in_grid(const DepthGrids& grids, const std::uint16_t* depth, std::uint16_t* nearest) {
  for (std::int64_t row = 0; row < grids.rows; ++row) {
    const auto line = [&](std::int64_t r) {
      return depth + std::clamp<std::int64_t>(r, 0, grids.rows - 1) * grids.columns;
    };
    nearest_in_row(line(row - 1), line(row), line(row + 1), grids.columns, nearest + row * grids.columns);
  }
}

// Cells of a row, from `first` on, as another frame sees them.
struct SeenCells {
  std::int32_t cells[kLanes];
  double depths[kLanes], margins[kLanes];
};
void see_cells(const DepthGrids& grids, const Pose<double>& motion, const std::uint16_t* depth, std::int64_t row,
               std::int64_t first, std::int64_t count, SeenCells& seen) {
  const double unit = grids.unit;
  SPS_SIMD
  for (std::int64_t c = 0; c < count; ++c) {
    const SeenCell cell = seen_cell(grids, motion, row, first + c, unit * depth[first + c]);
    seen.cells[c] = cell.cell;
    seen.depths[c] = cell.depth;
    seen.margins[c] = depth_margin(grids, cell.depth);
  }
}

}  // namespace

template <>
void find_moving_cells<Cpu>(Cpu device, const DepthGrids& grids, void* memory, std::uint8_t* cells,
                            std::int32_t* counts) {
  const std::int64_t num_cells = grids.rows * grids.columns, columns = grids.columns;
  const MovingWorkspace work = moving_workspace(grids, memory);
  std::fill_n(work.evidence, num_cells, 0u);
  for (std::int64_t cell = 0; cell < num_cells; ++cell) {
    work.depth[cell] = frame_cell(grids, cell / columns, cell % columns);
  }
  parallel_for(1 + grids.num_earlier, 1, [&](std::int64_t begin, std::int64_t end) {
    for (std::int64_t grid = begin; grid < end; ++grid) {
      const std::uint16_t* depth = grid == 0 ? work.depth : earlier_cells(grids, grid - 1);
      nearest_in_grid(grids, depth, work.nearest + grid * num_cells);
    }
  });
  const Pose<double> now = load_frame_pose(grids.pose);
  parallel_for(grids.num_earlier * grids.rows, kRowGrain, [&](std::int64_t begin, std::int64_t end) {
    SeenCells seen;
    for (std::int64_t line = begin; line < end; ++line) {
      const std::int64_t i = line / grids.rows, row = line % grids.rows;
      const Pose<double> then = load_frame_pose(grids.poses + kPoseSize * grids.frames[i]);
      const Pose<double> to_earlier = motion_between(now, then), to_now = motion_between(then, now);
      const std::uint16_t *earlier = earlier_cells(grids, i), *nearest = work.nearest + (1 + i) * num_cells;
      for (std::int64_t first = 0; first < columns; first += kLanes) {
        const std::int64_t count = std::min(kLanes, columns - first), begin_of_row = row * columns;
        see_cells(grids, to_earlier, work.depth + begin_of_row, row, first, count, seen);
        for (std::int64_t c = 0; c < count; ++c) {
          if (seen.cells[c] < 0) continue;
          const std::uint32_t found =
              earlier_evidence(grids, seen.depths[c], earlier[seen.cells[c]], nearest[seen.cells[c]], seen.margins[c]);
          if (found) __atomic_fetch_or(work.evidence + begin_of_row + first + c, found, __ATOMIC_RELAXED);
        }
        see_cells(grids, to_now, earlier + begin_of_row, row, first, count, seen);
        for (std::int64_t c = 0; c < count; ++c) {
          if (seen.cells[c] < 0 || !is_gone(grids, seen.depths[c], work.nearest[seen.cells[c]])) continue;
          __atomic_fetch_or(work.evidence + seen.cells[c], std::uint32_t{kGone}, __ATOMIC_RELAXED);
        }
      }
    }
  });
  counts[0] = counts[1] = 0;
  for (std::int64_t cell = 0; cell < num_cells; ++cell) {
    work.moving[cell] = is_moving(grids, work.evidence, work.depth, cell);
    counts[0] += work.moving[cell];
    counts[1] += work.depth[cell] != 0;
  }
  for_each(device, num_cells, [&](std::int64_t cell) { cells[cell] = is_marked_around(grids, work.moving, cell); });
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
