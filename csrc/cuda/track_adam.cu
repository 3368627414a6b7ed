// A tracking call: two kernels per iteration, the whole call one graph. Where the ray kernel does not support it, the
// launches of its parts one after the other.
#include "cuda/fused/block_sums.cuh"
#include "cuda/fused/ray_step.h"
#include "launch/track_adam.h"

namespace spslam {
namespace {

struct FusedTrackBuffers {
  PoseSearch* search;
  float* partials;
  std::int64_t bytes;

  FusedTrackBuffers(void* base, const PoseTracking& call) {
    Workspace memory(base);
    search = memory.take<PoseSearch>(1);
    partials = memory.take<float>(std::int64_t{fused::num_blocks(call.options.precision, false, call.rays.num_rays)} *
                                  fused::kTrackingPartialSize);
    bytes = memory.used();
  }
};

struct TrackStepArguments {
  const float* start;  // begins a search where not null
  const float* partials;
  int blocks;
  std::int64_t num_rays;
  LossWeights weights;
  AdamCoefficients<float> rotation, translation;
  PoseSearch* search;
  float *losses, *best;
};

// Sums of the blocks' terms: lane group g of the block adds blocks g, g + groups, .., then the groups in order.
__device__ void sum_tracking_terms(const TrackStepArguments& a, float* terms) {
  using namespace fused;
  constexpr int kGroups = kSumThreads / kTrackingPartialSize;
  __shared__ float shared[kGroups][kTrackingPartialSize];
  const int term = threadIdx.x % kTrackingPartialSize, group = threadIdx.x / kTrackingPartialSize;
  float sum = 0.0f;
#pragma unroll 8
  for (int b = group; b < a.blocks; b += kGroups) sum += __ldcg(a.partials + kTrackingPartialSize * b + term);
  shared[group][term] = sum;
  __syncthreads();
  if (threadIdx.x < kTrackingPartialSize) {
    float total = 0.0f;
#pragma unroll
    for (int g = 0; g < kGroups; ++g) total += shared[g][term];
    terms[term] = total;
  }
  __syncthreads();
}

__global__ void track_start_kernel(const __grid_constant__ TrackStepArguments a) {
  *a.search = start_pose_search(a.start);
}

__global__ void __launch_bounds__(fused::kSumThreads) track_step_kernel(const __grid_constant__ TrackStepArguments a) {
  using namespace fused;
  __shared__ float terms[kTrackingPartialSize];
  sum_tracking_terms(a, terms);
  if (threadIdx.x >= kWarp) return;
  const int lane = threadIdx.x;
  store_losses(lane < kLossSums ? terms[lane] : 0.0f, 0, lane, a.weights, a.num_rays, a.losses);
  if (lane != 0) return;
  PoseSearch search = *a.search;
  step_pose_search(a.rotation, a.translation, a.losses[0], terms + kLossSums, search);
  *a.search = search;
  for (int k = 0; k < kPoseSize; ++k) a.best[k] = search.best[k];
}

KernelLaunches fused_launches(const PoseTracking& call, const FusedTrackBuffers& buffers) {
  const auto adam = [](double rate, std::int64_t step) {
    return adam_coefficients<float>({rate, kAdamBeta1, kAdamBeta2, kAdamEpsilon, step});
  };
  TrackStepArguments step{};
  step.start = call.start;
  step.partials = buffers.partials;
  step.num_rays = call.rays.num_rays;
  step.weights = call.options.weights;
  step.search = buffers.search;
  step.best = call.best;
  KernelLaunches launches{{reinterpret_cast<const void*>(&track_start_kernel), 1, 1, 0, step}};
  for (std::int64_t iteration = 0; iteration < call.iterations; ++iteration) {
    RaySource rays = at_iteration(call.rays, iteration);
    rays.poses = buffers.search->pose;
    fused::RayStepArguments a =
        fused::make_arguments(call.scene, rays, call.intrinsics, at_iteration(call.options, iteration));
    a.pose = true;
    a.partials = buffers.partials;
    launches.push_back(fused::ray_launch(call.options.precision, false, a));
    step.blocks = launches.back().blocks;
    step.rotation = adam(call.rotation_rate, iteration + 1);
    step.translation = adam(call.translation_rate, iteration + 1);
    step.losses = call.losses + kLossTerms * iteration;
    launches.push_back({reinterpret_cast<const void*>(&track_step_kernel), 1, fused::kSumThreads, 0, step});
  }
  return launches;
}

}  // namespace

template <>
std::int64_t track_adam_workspace_size(Cuda device, const PoseTracking& call) {
  if (fused::covers(call.scene, call.options)) return FusedTrackBuffers(nullptr, call).bytes;
  return TrackAdamLaunch<Cuda>(device, call, nullptr).bytes();
}

template <>
void track_adam(Cuda device, const PoseTracking& call, void* workspace, LaunchGraph* graph) {
  if (!fused::covers(call.scene, call.options)) return TrackAdamLaunch<Cuda>(device, call, workspace).run();
  run_launches(fused_launches(call, FusedTrackBuffers(workspace, call)), graph,
               static_cast<cudaStream_t>(device.stream));
}

}  // namespace spslam
