// A mapping call put together from the launches of its parts, for any device.
#pragma once

#include "kernels/pose_adam.h"
#include "kernels/ray_source.h"
#include "launch/drawn_rays.h"
#include "launch/optimizer.h"
#include "spslam/optimize_map.h"

namespace spslam {

template <class Device>
struct OptimizeMapLaunch {
  OptimizeMapLaunch(Device device, const MapOptimization& call, void* base)
      : device_(device), call_(call), memory_(base), rays_(memory_, call.rays) {
    grad_poses_ = call.poses.exp_avg ? memory_.take<float>(kPoseGradientSize * call.rays.num_slots) : nullptr;
    grad_geometry_ = geometry_free() ? memory_.take<float>(kGeometryDecoder.num_params()) : nullptr;
    grad_color_ = color_free() ? memory_.take<float>(kColorDecoder.num_params()) : nullptr;
    const std::int64_t step_bytes = render_step_workspace_size(device, call.scene, batch(), call.options, gradients(0));
    step_workspace_ = memory_.take<char>(step_bytes);
  }

  std::int64_t bytes() const { return memory_.used(); }

  void run() {
    for (std::int64_t iteration = 0; iteration < call_.iterations; ++iteration) {
      rays_.draw(device_, at_iteration(call_.rays, iteration));
      render_step(device_, call_.scene, batch(), at_iteration(call_.options, iteration), gradients(iteration),
                  step_workspace_);
      step_scene(iteration);
      if (call_.poses.exp_avg) step_poses(iteration);
    }
  }

  bool geometry_free() const { return call_.geometry_params.exp_avg != nullptr; }
  bool color_free() const { return call_.color_params.exp_avg != nullptr; }

  RayBatch batch() const { return rays_.batch(call_.rays, call_.intrinsics); }

  std::int32_t stamp(std::int64_t iteration) const { return call_.first_stamp + static_cast<std::int32_t>(iteration); }

  RenderGradients gradients(std::int64_t iteration) const {
    return {call_.losses ? call_.losses + kLossTerms * iteration : nullptr,
            grad_poses_,
            table_gradients(call_.embeddings),
            call_.embeddings.stamps,
            table_gradients(call_.texels),
            call_.texels.stamps,
            grad_geometry_,
            grad_color_,
            stamp(iteration)};
  }

  // Zero has the same bits as float and as integer, so calls of either kind may share the memory.
  static float* table_gradients(const AdamTable& table) {
    return table.state.exp_avg ? static_cast<float*>(table.gradients) : nullptr;
  }

  AdamStep adam(const AdamState& state, std::int64_t iteration) const {
    return {state.learning_rate, kAdamBeta1, kAdamBeta2, kAdamEpsilon, state.first_step + iteration};
  }

  void step_scene(std::int64_t iteration) {
    step_table(call_.embeddings, call_.scene.num_voxels, kEmbeddingChannels, iteration);
    step_table(call_.texels, plane_rows(call_.scene.planes), kPlaneChannels, iteration);
    step_params(call_.geometry_params, kGeometryDecoder.num_params(), grad_geometry_, iteration);
    step_params(call_.color_params, kColorDecoder.num_params(), grad_color_, iteration);
  }

  void step_table(const AdamTable& table, std::int64_t rows, std::int64_t channels, std::int64_t iteration) {
    const AdamState& s = table.state;
    if (!s.exp_avg || rows == 0) return;
    sparse_adam(device_, adam(s, iteration), rows, channels, table.stamps, stamp(iteration), s.param,
                table_gradients(table), s.exp_avg, s.exp_avg_sq);
  }

  void step_params(const AdamState& s, std::int64_t count, float* gradient, std::int64_t iteration) {
    if (!s.exp_avg) return;
    sparse_adam(device_, adam(s, iteration), 1, count, static_cast<const std::int32_t*>(nullptr), 0, s.param, gradient,
                s.exp_avg, s.exp_avg_sq);
  }

  void step_poses(std::int64_t iteration) {
    const AdamCoefficients<float> c = adam_coefficients<float>(adam(call_.poses, iteration));
    const AdamState poses = call_.poses;
    const RaySource source = call_.rays;
    const float* gradients = grad_poses_;
    const std::int64_t fixed = call_.fixed_row;
    for_each(device_, source.num_slots, [=] SPS_HOST_DEVICE(std::int64_t slot) {
      const std::int64_t row = slot_row(source, slot), at = kPoseSize * row;
      if (row == fixed) return;
      pose_adam(c, c, gradients + kPoseGradientSize * slot, poses.param + at, poses.exp_avg + at,
                poses.exp_avg_sq + at);
    });
  }

  const Device device_;
  const MapOptimization& call_;
  Workspace memory_;
  DrawnRays rays_;
  float *grad_poses_, *grad_geometry_, *grad_color_;
  void* step_workspace_;
};

}  // namespace spslam
