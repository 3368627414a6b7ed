// A thread for each cell and earlier frame gathers evidence; two passes over the cells follow. One block numbers the
// records that stay.
#include "core/for_each.h"
#include "kernels/moving_objects.h"

namespace spslam {
namespace {

constexpr int kScanThreads = 1024;
constexpr int kWarp = 32;

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
std::int64_t moving_cells_workspace_size<Cuda>(Cuda, const DepthGrids& grids) {
  return grids.rows * grids.columns * static_cast<std::int64_t>(sizeof(std::uint32_t) + 1);
}

template <>
void find_moving_cells<Cuda>(Cuda device, const DepthGrids& grids, void* workspace, std::uint8_t* cells,
                             std::int32_t* counts) {
  const std::int64_t num_cells = grids.rows * grids.columns;
  std::uint32_t* evidence = static_cast<std::uint32_t*>(workspace);
  std::uint8_t* moving = reinterpret_cast<std::uint8_t*>(evidence + num_cells);
  const cudaStream_t stream = static_cast<cudaStream_t>(device.stream);
  cudaMemsetAsync(evidence, 0, static_cast<std::size_t>(num_cells) * sizeof(std::uint32_t), stream);
  cudaMemsetAsync(counts, 0, 2 * sizeof(std::int32_t), stream);
  for_each(device, grids.num_earlier * num_cells, [=] __device__(std::int64_t place) {
    const std::int64_t i = place / num_cells, row = place % num_cells / grids.columns, column = place % grids.columns;
    const Pose<double> now = load_frame_pose(grids.pose);
    const Pose<double> then = load_frame_pose(grids.poses + kPoseSize * grids.frames[i]);
    const std::uint32_t found = earlier_evidence(grids, i, then, now, row, column);
    if (found) atomicOr(evidence + row * grids.columns + column, found);
    const std::int64_t cell = gone_before(grids, i, then, now, row, column);
    if (cell >= 0) atomicOr(evidence + cell, std::uint32_t{kGone});
  });
  for_each(device, num_cells, [=] __device__(std::int64_t cell) {
    moving[cell] = is_moving(grids, evidence, cell);
    if (moving[cell]) atomicAdd(counts, 1);
    if (cell_depth(grids, cell / grids.columns, cell % grids.columns) > 0.0) atomicAdd(counts + 1, 1);
  });
  for_each(device, num_cells,
           [=] __device__(std::int64_t cell) { cells[cell] = is_marked_around(grids, moving, cell); });
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
