// One kernel for all copies: each would be a launch of its own, which takes the host longer than the device copies.
#include <algorithm>
#include <cstdint>

#include "core/cuda_check.cuh"
#include "spslam/row_copies.h"

namespace spslam {
namespace {

constexpr int kThreads = 256;
constexpr std::size_t kMaxBlocks = 64;  // of a copy
constexpr std::size_t kWide = sizeof(uint4);

struct RowCopies {
  RowCopy copies[kMaxRowCopies];
};

// A block of row y of the grid takes part in copy y: in steps of 16 bytes where both places are aligned so, then byte
// by byte.
__global__ void __launch_bounds__(kThreads) copy_kernel(const __grid_constant__ RowCopies all) {
  const RowCopy& copy = all.copies[blockIdx.y];
  const std::size_t first = blockIdx.x * std::size_t{kThreads} + threadIdx.x,
                    stride = gridDim.x * std::size_t{kThreads};
  const bool is_aligned =
      (reinterpret_cast<std::uintptr_t>(copy.to) | reinterpret_cast<std::uintptr_t>(copy.from)) % kWide == 0;
  const std::size_t wide = is_aligned ? copy.bytes / kWide : 0;
  for (std::size_t i = first; i < wide; i += stride) {
    static_cast<uint4*>(copy.to)[i] = static_cast<const uint4*>(copy.from)[i];
  }
  for (std::size_t i = wide * kWide + first; i < copy.bytes; i += stride) {
    static_cast<char*>(copy.to)[i] = static_cast<const char*>(copy.from)[i];
  }
}

}  // namespace

template <>
void copy_rows<Cuda>(Cuda device, const RowCopy* copies, int count) {
  RowCopies all{};
  std::size_t most = 0;
  for (int i = 0; i < count; ++i) {
    all.copies[i] = copies[i];
    most = std::max(most, copies[i].bytes);
  }
  if (most == 0) return;
  const std::size_t blocks = std::min((most / kWide + kThreads - 1) / kThreads + 1, kMaxBlocks);
  copy_kernel<<<dim3(static_cast<unsigned>(blocks), static_cast<unsigned>(count)), kThreads, 0,
                static_cast<cudaStream_t>(device.stream)>>>(all);
  SPS_CUDA_CHECK(cudaGetLastError());
}

}  // namespace spslam
