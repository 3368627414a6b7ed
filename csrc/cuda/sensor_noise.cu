// Two launches: all residuals are counted, then one block fits the model. Counts are whole numbers, so their order does
// not matter.
#include "core/cuda_check.cuh"
#include "kernels/sensor_noise.h"

namespace spslam {
namespace {

constexpr int kThreads = 128;
constexpr int kBins = kNoiseHistograms * kNoiseBins;

// Thread i takes pixel i, row k of the grid keyframe k.
__global__ void __launch_bounds__(kThreads)
    count_kernel(const std::int32_t* pixels, std::int64_t num_pixels, const float* pose, Intrinsics intrinsics,
                 const __grid_constant__ DepthKeyframes keyframes, std::int32_t* counts) {
  const std::int64_t i = std::int64_t{blockIdx.x} * kThreads + threadIdx.x;
  if (i >= num_pixels) return;
  const Pixel pixel = unpack_pixel(pixels + kPixelWords * i);
  if (!(pixel.depth > 0.0f)) return;
  const ColorPose color = color_pose(keyframes.poses, keyframes.frame_motion, keyframes.color_delay, pose);
  const PixelPoints points = pixel_points(pixel, surface_point(pixel, load_pose(pose), intrinsics), color, intrinsics);
  count_residuals(keyframes, load_depth_keyframe(keyframes, static_cast<int>(blockIdx.y)), pixel, points,
                  [&](std::int64_t at) { atomicAdd(counts + at, kResidualCount); });
}

__global__ void __launch_bounds__(kThreads) fit_kernel(std::int32_t* counts, float* noise) {
  __shared__ BinVariance bins[kBins];
  for (int b = threadIdx.x; b < kBins; b += kThreads) {
    bins[b] = bin_variance(counts + std::int64_t{b} * kNoiseLevels, b / kNoiseBins);
  }
  __syncthreads();
  if (threadIdx.x < kNoiseHistograms) {
    const int histogram = static_cast<int>(threadIdx.x);
    fit_noise(bins + kNoiseBins * histogram, histogram, noise + 2 * histogram);
  }
  for (std::int64_t i = threadIdx.x; i < kNoiseCounts; i += kThreads) counts[i] -= counts[i] >> kFadeShift;
}

}  // namespace

template <>
void measure_noise<Cuda>(Cuda device, const std::int32_t* pixels, std::int64_t num_pixels, const float* pose,
                         const Intrinsics& intrinsics, const DepthKeyframes& keyframes, std::int32_t* counts,
                         float* noise) {
  const cudaStream_t stream = static_cast<cudaStream_t>(device.stream);
  if (num_pixels > 0 && keyframes.count > 0) {
    const dim3 grid(static_cast<unsigned>((num_pixels + kThreads - 1) / kThreads),
                    static_cast<unsigned>(keyframes.count));
    count_kernel<<<grid, kThreads, 0, stream>>>(pixels, num_pixels, pose, intrinsics, keyframes, counts);
    SPS_CUDA_CHECK(cudaGetLastError());
  }
  fit_kernel<<<1, kThreads, 0, stream>>>(counts, noise);
  SPS_CUDA_CHECK(cudaGetLastError());
}

}  // namespace spslam
