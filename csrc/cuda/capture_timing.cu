// Two launches: blocks sum over their pixels against one keyframe each, then one block adds their sums in
// order.
#include "core/cuda_check.cuh"
#include "cuda/warp_sums.cuh"
#include "kernels/capture_timing.h"

namespace spslam {
namespace {

constexpr int kWarps = 4;
constexpr int kThreads = kWarps * kWarp;
constexpr int kSums = 2 * kWarp;  // terms are summed 32 at a time
static_assert(kTimingTerms <= kSums, "two lanes' worth of terms");

std::int64_t block_count(std::int64_t num_pixels) {
  return (num_pixels + kThreads - 1) / kThreads;
}

// Thread i takes pixel i, row k of the grid keyframe k; partials [rows, blocks, kSums].
__global__ void __launch_bounds__(kThreads)
    sum_kernel(const std::int32_t* pixels, std::int64_t num_pixels, const float* pose, Intrinsics intrinsics,
               const float* noise, const __grid_constant__ DepthKeyframes keyframes, const float* timing,
               double* partials) {
  __shared__ MovingFrame frame;
  __shared__ MovingKeyframe keyframe;
  __shared__ float sums[kWarps][kSums];
  if (threadIdx.x == 0) frame = load_moving_frame(keyframes, pose);
  if (threadIdx.x == kWarp) keyframe = load_moving_keyframe(keyframes, static_cast<int>(blockIdx.y), timing);
  __syncthreads();
  const std::int64_t i = std::int64_t{blockIdx.x} * kThreads + threadIdx.x;
  const int lane = threadIdx.x % kWarp, warp = threadIdx.x / kWarp;
  float terms[kSums] = {};
  if (i < num_pixels) {
    const Pixel pixel = unpack_pixel(pixels + kPixelWords * i);
    add_timing_residuals(keyframes, keyframe, frame, pixel, intrinsics, load_sensor_noise(noise), terms);
  }
  float first[kWarp], second[kWarp];
  for (int t = 0; t < kWarp; ++t) first[t] = terms[t], second[t] = terms[kWarp + t];
  sums[warp][lane] = transpose_sum(first, lane);
  sums[warp][kWarp + lane] = transpose_sum(second, lane);
  __syncthreads();
  if (threadIdx.x >= kSums) return;
  double sum = 0.0;
  for (int w = 0; w < kWarps; ++w) sum += static_cast<double>(sums[w][threadIdx.x]);
  partials[(std::int64_t{blockIdx.y} * gridDim.x + blockIdx.x) * kSums + threadIdx.x] = sum;
}

__global__ void __launch_bounds__(kSums)
    update_kernel(const double* partials, std::int64_t blocks, int keyframes, double* state, float* timing) {
  __shared__ double terms[kSums];
  TimingEvidence all{};
  for (int k = 0; k < keyframes; ++k) {
    double sum = 0.0;
    for (std::int64_t b = 0; b < blocks; ++b) sum += partials[(k * blocks + b) * kSums + threadIdx.x];
    terms[threadIdx.x] = sum;
    __syncthreads();
    if (threadIdx.x == 0) add_timing_evidence(terms, all);
    __syncthreads();
  }
  if (threadIdx.x == 0) update_capture_timing(all, state, timing);
}

}  // namespace

template <>
std::int64_t capture_timing_workspace_size<Cuda>(Cuda, std::int64_t num_pixels, std::int64_t keyframes) {
  return block_count(num_pixels) * keyframes * kSums * static_cast<std::int64_t>(sizeof(double));
}

template <>
void measure_capture_timing<Cuda>(Cuda device, const std::int32_t* pixels, std::int64_t num_pixels, const float* pose,
                                  const Intrinsics& intrinsics, const float* noise, const DepthKeyframes& keyframes,
                                  void* workspace, double* state, float* timing) {
  if (num_pixels == 0 || keyframes.count == 0) return;
  const cudaStream_t stream = static_cast<cudaStream_t>(device.stream);
  double* partials = static_cast<double*>(workspace);
  const dim3 grid(static_cast<unsigned>(block_count(num_pixels)), static_cast<unsigned>(keyframes.count));
  sum_kernel<<<grid, kThreads, 0, stream>>>(pixels, num_pixels, pose, intrinsics, noise, keyframes, timing, partials);
  SPS_CUDA_CHECK(cudaGetLastError());
  update_kernel<<<1, kSums, 0, stream>>>(partials, grid.x, keyframes.count, state, timing);
  SPS_CUDA_CHECK(cudaGetLastError());
}

}  // namespace spslam
