// A thread for each cell and earlier frame gathers evidence; two passes over the cells follow. One block numbers the
// records that stay.
#include "core/for_each.h"
#include "kernels/moving_objects.h"

namespace spslam {
namespace {

constexpr int kScanThreads = 1024;
constexpr int kWarp = 32;

// Least known depth in a cell and those around it; `depth` returns that of a row and column.
template <class Depth>
__device__ std::uint16_t nearest_around(const DepthGrids& grids, std::int64_t row, std::int64_t column,
                                        const Depth& depth) {
  std::uint16_t nearest = 0;
  for (std::int64_t r = row > 0 ? row - 1 : 0; r <= row + 1 && r < grids.rows; ++r) {
    for (std::int64_t c = column > 0 ? column - 1 : 0; c <= column + 1 && c < grids.columns; ++c) {
      nearest = nearer(nearest, depth(r, c));
    }
  }
  return nearest;
}

// places [num_records]: the records that stay, in order; places[num_records] is their number.
__global__ void __launch_bounds__(kScanThreads)
    place_kernel(FrameSamples samples, const std::uint8_t* cells, std::int32_t* places, std::int32_t* ranks) {
  __shared__ int counts[kScanThreads / kWarp];
  int passed = 0;
  for (std::int64_t first = 0; first < samples.num_records; first += kScanThreads) {
    const std::int64_t i = first + threadIdx.x;
    const bool stays = i < samples.num_records && !is_record_marked(samples, cells, i);
    const unsigned votes = __ballot_sync(0xffffffffu, stays);
    const int lane = threadIdx.x % kWarp, warp = threadIdx.x / kWarp;
    if (lane == 0) counts[warp] = __popc(votes);
    __syncthreads();
    int before = passed + __popc(votes & ((1u << lane) - 1u)), total = 0;
    for (int w = 0; w < kScanThreads / kWarp; ++w) {
      if (w < warp) before += counts[w];
      total += counts[w];
    }
    if (stays) places[before] = static_cast<std::int32_t>(i);
    // The rank among those that stay, or among those left out.
    if (i < samples.num_records) ranks[i] = stays ? -1 : static_cast<std::int32_t>(i) - before;
    passed += total;
    __syncthreads();
  }
  if (threadIdx.x == 0) places[samples.num_records] = passed;
}

}  // namespace

template <>
void find_moving_cells<Cuda>(Cuda device, const DepthGrids& grids, void* memory, std::uint8_t* cells,
                             std::int32_t* counts) {
  const std::int64_t num_cells = grids.rows * grids.columns;
  const MovingWorkspace work = moving_workspace(grids, memory);
  for_each(device, (1 + grids.num_earlier) * num_cells, [=] __device__(std::int64_t place) {
    const std::int64_t grid = place / num_cells, cell = place % num_cells;
    const std::int64_t row = cell / grids.columns, column = cell % grids.columns;
    const std::uint16_t* earlier = grid > 0 ? earlier_cells(grids, grid - 1) : nullptr;
    const auto depth = [&](std::int64_t r, std::int64_t c) {
      return earlier != nullptr ? earlier[r * grids.columns + c] : frame_cell(grids, r, c);
    };
    work.nearest[place] = nearest_around(grids, row, column, depth);
    if (grid > 0) return;
    work.depth[cell] = depth(row, column);
    work.evidence[cell] = 0u;
    if (cell == 0) counts[0] = counts[1] = 0;
  });
  for_each(device, grids.num_earlier * num_cells, [=] __device__(std::int64_t place) {
    const std::int64_t i = place / num_cells, cell = place % num_cells;
    const std::int64_t row = cell / grids.columns, column = cell % grids.columns;
    const Pose<double> now = load_frame_pose(grids.pose);
    const Pose<double> then = load_frame_pose(grids.poses + kPoseSize * grids.frames[i]);
    const std::uint16_t* earlier = earlier_cells(grids, i);
    const SeenCell seen = seen_cell(grids, motion_between(now, then), row, column, grids.unit * work.depth[cell]);
    if (seen.cell >= 0) {
      const std::uint32_t found =
          earlier_evidence(grids, seen.depth, earlier[seen.cell], work.nearest[(1 + i) * num_cells + seen.cell],
                           depth_margin(grids, seen.depth));
      if (found) atomicOr(work.evidence + cell, found);
    }
    const SeenCell before = seen_cell(grids, motion_between(then, now), row, column, grids.unit * earlier[cell]);
    if (before.cell >= 0 && is_gone(grids, before.depth, work.nearest[before.cell])) {
      atomicOr(work.evidence + before.cell, std::uint32_t{kGone});
    }
  });
  for_each(device, num_cells, [=] __device__(std::int64_t cell) {
    work.moving[cell] = is_moving(grids, work.evidence, work.depth, cell);
    if (work.moving[cell]) atomicAdd(counts, 1);
    if (work.depth[cell] != 0) atomicAdd(counts + 1, 1);
  });
  for_each(device, num_cells,
           [=] __device__(std::int64_t cell) { cells[cell] = is_marked_around(grids, work.moving, cell); });
}

template <>
void leave_out_moving<Cuda>(Cuda device, const FrameSamples& samples, const std::uint8_t* cells,
                            const std::int32_t* counts, std::int32_t* places, std::int32_t* records, float* normals,
                            std::uint16_t* depth, std::uint16_t* thumbnail) {
  if (samples.num_records == 0) return;
  std::int32_t* ranks = places + samples.num_records + 1;
  place_kernel<<<1, kScanThreads, 0, static_cast<cudaStream_t>(device.stream)>>>(samples, cells, places, ranks);
  const std::int32_t* kept = places + samples.num_records;
  for_each(device, samples.num_records, [=] __device__(std::int64_t i) {
    const bool is_replaced = ranks[i] >= 0 && leaves_out(samples, counts, *kept);
    copy_sample(samples, is_replaced ? places[ranks[i] % *kept] : i, i, records, normals);
  });
  for_each(device, samples.height * samples.width, [=] __device__(std::int64_t i) {
    const bool is_out = is_in_marked(samples, cells, i / samples.width, i % samples.width);
    depth[i] = is_out && leaves_out(samples, counts, *kept) ? std::uint16_t{0} : samples.depth[i];
  });
  for_each(device, samples.thumbnail_rows * samples.thumbnail_columns, [=] __device__(std::int64_t i) {
    const bool is_out = is_thumbnail_marked(samples, cells, i) && leaves_out(samples, counts, *kept);
    thumbnail[i] = is_out ? std::uint16_t{0} : samples.thumbnail[i];
  });
}

}  // namespace spslam
