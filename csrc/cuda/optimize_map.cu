// A mapping call: two kernels per iteration, the whole call one graph. Where the ray kernel does not support it, the
// launches of its parts one after the other.
#include "cuda/fused/map_update.cuh"
#include "cuda/fused/ray_step.h"
#include "launch/optimize_map.h"

namespace spslam {
namespace {

// Enough to read the stamps of all tables' rows once, with several blocks on each multiprocessor.
constexpr int kUpdateBlocks = 1056;

struct FusedMapBuffers {
  float *partials, *pose_gradients;
  std::int64_t bytes;

  FusedMapBuffers(void* base, const MapOptimization& call) {
    Workspace memory(base);
    partials = memory.take<float>(std::int64_t{fused::num_blocks(call.options.precision, true, call.rays.num_rays)} *
                                  fused::kPartialSize);
    pose_gradients = memory.take<float>(call.rays.num_rays * fused::kPoseGradientStride);
    bytes = memory.used();
  }
};

bool aligned(const AdamTable& table) {
  constexpr std::uintptr_t kVectorBytes = 16;
  const AdamState& s = table.state;
  const auto bits = [](const void* p) { return reinterpret_cast<std::uintptr_t>(p); };
  return (bits(s.param) | bits(s.exp_avg) | bits(s.exp_avg_sq) | bits(table.gradients)) % kVectorBytes == 0;
}

bool fused_covers(const MapOptimization& call) {
  return fused::covers(call.scene, call.options) && aligned(call.embeddings) && aligned(call.texels);
}

fused::AdamTarget target(const AdamState& s, std::int64_t iteration) {
  const AdamStep adam{s.learning_rate, kAdamBeta1, kAdamBeta2, kAdamEpsilon, s.first_step + iteration};
  return {s.param, s.exp_avg, s.exp_avg_sq, adam_coefficients<float>(adam)};
}

fused::TableTarget table_target(const AdamTable& t, std::int64_t rows, std::int64_t iteration) {
  return {target(t.state, iteration), static_cast<std::int64_t*>(t.gradients), t.stamps, rows};
}

fused::TableSums table_sums(const AdamTable& t) {
  return {t.state.exp_avg ? static_cast<std::int64_t*>(t.gradients) : nullptr, t.stamps};
}

// Writes two launches for each iteration.
class MapLaunches {
 public:
  MapLaunches(const MapOptimization& call, const FusedMapBuffers& buffers) : call_(call), buffers_(buffers) {}

  KernelLaunches all() const {
    KernelLaunches launches;
    launches.reserve(2 * call_.iterations);
    for (std::int64_t iteration = 0; iteration < call_.iterations; ++iteration) {
      const fused::RayStepArguments rays = ray_arguments(iteration);
      launches.push_back(fused::ray_launch(call_.options.precision, true, rays));
      launches.push_back({reinterpret_cast<const void*>(&fused::map_update_kernel), kUpdateBlocks, fused::kSumThreads,
                          0, update_arguments(iteration, rays, launches.back().blocks)});
    }
    return launches;
  }

 private:
  fused::RayStepArguments ray_arguments(std::int64_t iteration) const {
    fused::RayStepArguments a = fused::make_arguments(call_.scene, at_iteration(call_.rays, iteration),
                                                      call_.intrinsics, at_iteration(call_.options, iteration));
    a.pose = call_.poses.exp_avg != nullptr;
    a.geometry_params = call_.geometry_params.exp_avg != nullptr;
    a.color_params = a.color && call_.color_params.exp_avg;
    a.embeddings = table_sums(call_.embeddings);
    a.texels = a.color ? table_sums(call_.texels) : fused::TableSums{};
    a.stamp = call_.first_stamp + static_cast<std::int32_t>(iteration);
    a.partials = buffers_.partials;
    a.pose_gradients = buffers_.pose_gradients;
    return a;
  }

  fused::MapUpdateArguments update_arguments(std::int64_t iteration, const fused::RayStepArguments& rays,
                                             int blocks) const {
    fused::MapUpdateArguments a{};
    a.partials = buffers_.partials;
    a.pose_gradients = buffers_.pose_gradients;
    a.blocks = blocks;
    a.rays = rays.rays;
    a.fixed_row = call_.fixed_row;
    a.geometry = target(call_.geometry_params, iteration);
    a.color = target(call_.color_params, iteration);
    a.poses = target(call_.poses, iteration);
    a.embeddings = table_target(call_.embeddings, call_.scene.num_voxels, iteration);
    a.texels = table_target(call_.texels, plane_rows(call_.scene.planes), iteration);
    a.inverse_scale = 1.0f / rays.fixed_point_scale;
    a.stamp = rays.stamp;
    a.weights = call_.options.weights;
    a.losses = call_.losses + kLossTerms * iteration;
    return a;
  }

  const MapOptimization& call_;
  const FusedMapBuffers& buffers_;
};

}  // namespace

template <>
std::int64_t optimize_map_workspace_size(Cuda device, const MapOptimization& call) {
  if (fused_covers(call)) return FusedMapBuffers(nullptr, call).bytes;
  return OptimizeMapLaunch<Cuda>(device, call, nullptr).bytes();
}

template <>
void optimize_map(Cuda device, const MapOptimization& call, void* workspace, LaunchGraph* graph) {
  if (!fused_covers(call)) return OptimizeMapLaunch<Cuda>(device, call, workspace).run();
  run_launches(MapLaunches(call, FusedMapBuffers(workspace, call)).all(), graph,
               static_cast<cudaStream_t>(device.stream));
}

}  // namespace spslam
