// Blocks compare points of a frame each and add up its cells in shared memory; one thread finishes.
#include "core/for_each.h"
#include "kernels/brightness_sums.h"

namespace spslam {
namespace {

constexpr int kPointThreads = 256;
using Sum = unsigned long long;  // of numbers that are not negative, as atomicAdd takes them

__global__ void compare_kernel(SeenPixels seen, const std::int64_t* rows, ShownImages shown, const float* pose,
                               std::int64_t* cells) {
  extern __shared__ Sum own_cells[];
  const int num_sums = static_cast<int>(cells_of_frame(seen)) * kBrightnessSums;
  for (int s = threadIdx.x; s < num_sums; s += kPointThreads) own_cells[s] = 0;
  __syncthreads();
  const std::int64_t row = rows[blockIdx.y], p = blockIdx.x * std::int64_t{kPointThreads} + threadIdx.x;
  if (is_row(seen, row) && p < seen.num_points) {
    const std::int32_t* record = seen.records + kPixelWords * (seen.num_records * row + p);
    const Pose<double> from = load_frame_pose(seen.poses + kPoseSize * row), own = load_frame_pose(pose);
    const PointBrightness point = compared_brightness(seen, record, from, shown, own);
    if (point.cell >= 0) {
      Sum* cell = own_cells + kBrightnessSums * point.cell;
      add_brightness(point,
                     [cell](int which, std::int64_t value) { atomicAdd(cell + which, static_cast<Sum>(value)); });
    }
  }
  __syncthreads();
  Sum* all = reinterpret_cast<Sum*>(cells) + static_cast<std::int64_t>(num_sums) * blockIdx.y;
  for (int s = threadIdx.x; s < num_sums; s += kPointThreads) {
    if (own_cells[s] != 0) atomicAdd(all + s, own_cells[s]);
  }
}

}  // namespace

template <>
std::int64_t brightness_workspace_size<Cuda>(Cuda, const SeenPixels& seen, std::int64_t num_rows) {
  return num_rows * cells_of_frame(seen) * kBrightnessSums * static_cast<std::int64_t>(sizeof(std::int64_t));
}

template <>
void sum_brightness<Cuda>(Cuda device, const SeenPixels& seen, const std::int64_t* rows, std::int64_t num_rows,
                          const ShownImages& shown, const float* pose, void* workspace, double* sums) {
  const cudaStream_t stream = static_cast<cudaStream_t>(device.stream);
  std::int64_t* cells = static_cast<std::int64_t*>(workspace);
  const std::int64_t num_cells = num_rows * cells_of_frame(seen);
  for_each(device, num_cells * kBrightnessSums, [=] __device__(std::int64_t i) { cells[i] = 0; });
  if (num_rows > 0 && seen.num_points > 0) {
    const dim3 blocks(static_cast<unsigned>((seen.num_points + kPointThreads - 1) / kPointThreads),
                      static_cast<unsigned>(num_rows));
    const std::size_t shared = static_cast<std::size_t>(cells_of_frame(seen)) * kBrightnessSums * sizeof(Sum);
    compare_kernel<<<blocks, kPointThreads, shared, stream>>>(seen, rows, shown, pose, cells);
  }
  for_each(device, 1, [=] __device__(std::int64_t) { finish_brightness(cells, num_cells, sums); });
}

}  // namespace spslam
