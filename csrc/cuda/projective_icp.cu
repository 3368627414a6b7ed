// One block runs all iterations of a cloud: summing a few thousand points takes less time than a barrier between
// blocks.
#include "cuda/warp_sums.cuh"
#include "kernels/projective_icp.h"

namespace spslam {
namespace {

constexpr int kWarps = 16;
constexpr int kThreads = kWarps * kWarp;
static_assert(kTrackingTerms <= kWarp, "one lane per term");

__global__ void __launch_bounds__(kThreads) icp_kernel(PointClouds sources, SurfaceMaps target, IcpOptions options,
                                                       float* poses, float* stats, float* hessians) {
  const std::int64_t cloud = blockIdx.x, num_points = sources.size;
  const float* points = sources.points + 3 * num_points * cloud;
  float* pose = poses + kPoseSize * cloud;
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
    float* own_stats = stats + kTrackingStatSize * (options.iterations * cloud + iteration);
    if (threadIdx.x == 0) tracking_step(terms, terms, options.damping, 0.0, own_pose, own_stats + 2, own_hessian);
    if (threadIdx.x == kWarp) tracking_fit(terms, num_points, own_stats);
    __syncthreads();
  }
  if (threadIdx.x < kPoseSize) pose[threadIdx.x] = own_pose[threadIdx.x];
  if (threadIdx.x < 36) hessians[36 * cloud + threadIdx.x] = own_hessian[threadIdx.x];
}

}  // namespace

template <>
std::int64_t projective_icp_workspace_size<Cuda>(Cuda, const PointClouds&) {
  return 0;
}

template <>
void projective_icp<Cuda>(Cuda device, const PointClouds& sources, const SurfaceMaps& target, const IcpOptions& options,
                          void*, float* poses, float* stats, float* hessians) {
  if (sources.count == 0) return;
  const unsigned blocks = static_cast<unsigned>(sources.count);
  icp_kernel<<<blocks, kThreads, 0, static_cast<cudaStream_t>(device.stream)>>>(sources, target, options, poses, stats,
                                                                                hessians);
}

}  // namespace spslam
