// A tracking call put together from the launches of its parts, for any device.
#pragma once

#include "launch/drawn_rays.h"
#include "launch/optimizer.h"
#include "spslam/track_adam.h"

namespace spslam {

// All members are public: nvcc takes no device lambda from a private function.
template <class Device>
struct TrackAdamLaunch {
  TrackAdamLaunch(Device device, const PoseTracking& call, void* base)
      : device_(device), call_(call), memory_(base), source_(call.rays), rays_(memory_, call.rays) {
    search_ = memory_.take<PoseSearch>(1);
    grad_pose_ = memory_.take<float>(kPoseGradientSize);
    source_.poses = search_ ? search_->pose : nullptr;
    step_workspace_ =
        memory_.take<char>(render_step_workspace_size(device, call.scene, batch(), call.options, gradients(0)));
  }

  std::int64_t bytes() const { return memory_.used(); }

  void run() {
    start();
    for (std::int64_t iteration = 0; iteration < call_.iterations; ++iteration) {
      rays_.draw(device_, at_iteration(source_, iteration));
      render_step(device_, call_.scene, batch(), at_iteration(call_.options, iteration), gradients(iteration),
                  step_workspace_);
      step(iteration);
    }
    finish();
  }

  RayBatch batch() const { return rays_.batch(source_, call_.intrinsics); }

  RenderGradients gradients(std::int64_t iteration) const {
    RenderGradients gradients{};
    gradients.losses = call_.losses ? call_.losses + kLossTerms * iteration : nullptr;
    gradients.poses = grad_pose_;
    return gradients;
  }

  AdamCoefficients<float> adam(double rate, std::int64_t iteration) const {
    return adam_coefficients<float>({rate, kAdamBeta1, kAdamBeta2, kAdamEpsilon, iteration + 1});
  }

  void start() {
    const float* pose = call_.start;
    PoseSearch* search = search_;
    for_each(device_, 1, [=] SPS_HOST_DEVICE(std::int64_t) { *search = start_pose_search(pose); });
  }

  void step(std::int64_t iteration) {
    const AdamCoefficients<float> rotation = adam(call_.rotation_rate, iteration);
    const AdamCoefficients<float> translation = adam(call_.translation_rate, iteration);
    const float *losses = call_.losses + kLossTerms * iteration, *gradient = grad_pose_;
    PoseSearch* search = search_;
    for_each(device_, 1, [=] SPS_HOST_DEVICE(std::int64_t) {
      step_pose_search(rotation, translation, losses[0], gradient, *search);
    });
  }

  void finish() {
    const PoseSearch* search = search_;
    float* best = call_.best;
    for_each(device_, kPoseSize, [=] SPS_HOST_DEVICE(std::int64_t i) { best[i] = search->best[i]; });
  }

  const Device device_;
  const PoseTracking& call_;
  Workspace memory_;
  RaySource source_;
  DrawnRays rays_;
  PoseSearch* search_;
  float* grad_pose_;
  void* step_workspace_;
};

}  // namespace spslam
