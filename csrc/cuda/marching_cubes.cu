#include <cub/block/block_scan.cuh>

#include "core/cuda_check.cuh"
#include "launch/marching_cubes.h"

namespace spslam {
namespace {

constexpr int kScanThreads = 512;

// One block for each array (blockIdx.x): counts into the running sum before each, the total past the last.
__global__ void __launch_bounds__(kScanThreads)
    exclusive_sums(std::int64_t count, std::int64_t* first, std::int64_t* second) {
  using BlockScan = cub::BlockScan<std::int64_t, kScanThreads>;
  __shared__ typename BlockScan::TempStorage storage;
  std::int64_t* values = blockIdx.x == 0 ? first : second;
  std::int64_t carry = 0;
  for (std::int64_t base = 0; base < count; base += kScanThreads) {
    const std::int64_t i = base + threadIdx.x;
    std::int64_t value = i < count ? values[i] : 0, sum = 0, total = 0;
    BlockScan(storage).ExclusiveSum(value, sum, total);
    if (i < count) values[i] = carry + sum;
    carry += total;
    __syncthreads();
  }
  if (threadIdx.x == 0) values[count] = carry;
}

}  // namespace

template <>
MarchingCubesCounts marching_cubes_count<Cuda>(Cuda device, const MarchingCubesCells& cells, void* workspace) {
  const MarchingCubesWork work = marching_cubes_layout(cells, workspace);
  const cudaStream_t stream = static_cast<cudaStream_t>(device.stream);
  marching_cubes_mark(device, cells, work);
  exclusive_sums<<<2, kScanThreads, 0, stream>>>(cells.count, work.vertex_offsets, work.face_offsets);
  SPS_CUDA_CHECK(cudaGetLastError());
  std::int64_t vertices = 0, faces = 0;
  std::uint64_t faults = 0;
  const auto fetch = [&](void* to, const void* from) {
    SPS_CUDA_CHECK(cudaMemcpyAsync(to, from, sizeof(std::int64_t), cudaMemcpyDeviceToHost, stream));
  };
  fetch(&vertices, work.vertex_offsets + cells.count);
  fetch(&faces, work.face_offsets + cells.count);
  fetch(&faults, work.faults);
  SPS_CUDA_CHECK(cudaStreamSynchronize(stream));
  return {vertices, faces, faults};
}

SPS_INSTANTIATE_MARCHING_CUBES(Cuda)

}  // namespace spslam
