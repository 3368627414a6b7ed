#include "spslam/projective_icp.h"

#include "core/parallel.h"
#include "cpu/term_sums.h"
#include "kernels/projective_icp.h"

namespace spslam {
namespace {

// Points summed by one worker before its sums are added to the others', in order.
constexpr std::int64_t kPointGrain = 512;

void align(const float* points, std::int64_t num_points, const SurfaceMaps& target, const IcpOptions& options,
           double* terms, float* pose, float* stats, float* hessian) {
  double* partials = terms + kTrackingTerms;
  for (std::int64_t iteration = 0; iteration < options.iterations; ++iteration) {
    const Pose<float> current = load_pose(pose);
    const float kernel = annealed_kernel(options.kernel_start, options.kernel_end, iteration, options.iterations);
    const auto add_points = [&](std::int64_t begin, std::int64_t end, double* own) {
      for (std::int64_t i = begin; i < end; ++i) {
        add_icp_residual(target, points + 3 * i, current, options.max_distance, kernel, own);
      }
    };
    sum_terms<kTrackingTerms>(num_points, kPointGrain, partials, terms, add_points);
    float* own_stats = stats + kTrackingStatSize * iteration;
    tracking_fit(terms, num_points, own_stats);
    tracking_step(terms, terms, options.damping, 0.0, pose, own_stats + 2, hessian);
  }
}

}  // namespace

template <>
std::int64_t projective_icp_workspace_size<Cpu>(Cpu, const PointClouds& sources) {
  return (chunk_count(sources.size, kPointGrain) + 1) * kTrackingTerms * static_cast<std::int64_t>(sizeof(double));
}

template <>
void projective_icp<Cpu>(Cpu, const PointClouds& sources, const SurfaceMaps& target, const IcpOptions& options,
                         void* workspace, float* poses, float* stats, float* hessians) {
  for (std::int64_t cloud = 0; cloud < sources.count; ++cloud) {
    align(sources.points + 3 * sources.size * cloud, sources.size, target, options, static_cast<double*>(workspace),
          poses + kPoseSize * cloud, stats + kTrackingStatSize * options.iterations * cloud, hessians + 36 * cloud);
  }
}

}  // namespace spslam
