// One block runs all iterations: summing a few thousand points takes less time than a barrier between blocks.
#include "cuda/warp_sums.cuh"
#include "kernels/projective_icp.h"

namespace spslam {
namespace {

constexpr int kWarps = 16;
constexpr int kThreads = kWarps * kWarp;
static_assert(kTrackingTerms <= kWarp, "one lane per term");

__global__ void __launch_bounds__(kThreads) icp_kernel(const float* points, std::int64_t num_points, SurfaceMaps target,
                                                       IcpOptions options, float* pose, float* stats, float* hessian) {
  __shared__ float sums[kWarps][kWarp];
  __shared__ double terms[kWarp];
  __shared__ float own_pose[kPoseSize], own_hessian[36];
  const int lane = threadIdx.x % kWarp, warp = threadIdx.x / kWarp;
  if (threadIdx.x < kPoseSize) own_pose[threadIdx.x] = pose[threadIdx.x];
  __syncthreads();
  for (std::int64_t iteration = 0; iteration < options.iterations; ++iteration) {
    const Pose<float> current = load_pose(own_pose);
    const float kernel = annealed_kernel(options.kernel_start, options.kernel_end, iteration, options.iterations);
    float own[kWarp] = {};
    for (std::int64_t i = threadIdx.x; i < num_points; i += kThreads) {
      add_icp_residual(target, points + 3 * i, current, options.max_distance, kernel, own);
    }
    sums[warp][lane] = transpose_sum(own, lane);
    __syncthreads();
    if (warp == 0) {
      double sum = 0.0;
      for (int w = 0; w < kWarps; ++w) sum += static_cast<double>(sums[w][lane]);
      terms[lane] = sum;
    }
    __syncthreads();
    float* own_stats = stats + kTrackingStatSize * iteration;
    if (threadIdx.x == 0) tracking_step(terms, terms, options.damping, 0.0, own_pose, own_stats + 2, own_hessian);
    if (threadIdx.x == kWarp) tracking_fit(terms, num_points, own_stats);
    __syncthreads();
  }
  if (threadIdx.x < kPoseSize) pose[threadIdx.x] = own_pose[threadIdx.x];
  if (threadIdx.x < 36) hessian[threadIdx.x] = own_hessian[threadIdx.x];
}

}  // namespace

template <>
std::int64_t projective_icp_workspace_size<Cuda>(Cuda, std::int64_t) {
  return 0;
}

template <>
void projective_icp<Cuda>(Cuda device, const float* points, std::int64_t num_points, const SurfaceMaps& target,
                          const IcpOptions& options, void*, float* pose, float* stats, float* hessian) {
  icp_kernel<<<1, kThreads, 0, static_cast<cudaStream_t>(device.stream)>>>(points, num_points, target, options, pose,
                                                                           stats, hessian);
}

}  // namespace spslam
