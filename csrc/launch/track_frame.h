// The call put together from the launches of its parts, for any device.
#pragma once

#include "core/for_each.h"
#include "kernels/frame_outcome.h"
#include "kernels/pixel_record.h"
#include "launch/workspace.h"

namespace spslam {

// All members are public: nvcc takes no device lambda from a private function.
template <class Device>
struct TrackFrameLaunch {
  TrackFrameLaunch(Device device, const FrameTracking& call, void* base) : device_(device), call_(call), memory_(base) {
    unbent_ = memory_.take<std::int32_t>(kPixelWords * call.num_records);
    tracking_ = memory_.take<char>(gauss_newton_workspace_size(device, 1, call.options.num_pixels));
  }

  std::int64_t bytes() const { return memory_.used(); }

  void run(const TrackedFrameOutput& out) {
    predict_frame(device_, call_.recent, call_.readout, call_.seconds, call_.records, call_.num_records, call_.camera,
                  {out.predicted, out.readout, out.predicted_records});
    start(out);
    track(out.predicted_records, call_.options, out.first);
    decide(out);
    // Both only of a bent frame.
    GaussNewtonOptions again = call_.options;
    again.iterations = call_.again_iterations;
    again.kernel_start = again.kernel_end;
    again.depth_keyframes.first_iteration = 0;
    again.wanted = out.outcome;
    rectify_shutter_records(device_, call_.records, call_.num_records, motion(out, out.first.pose), call_.camera,
                            unbent_, out.outcome);
    track(unbent_, again, out.found);
    rectify_shutter_frame(device_, call_.records, call_.num_records, call_.images, motion(out, out.found.pose),
                          call_.camera, call_.image_camera, out.rectified);
  }

  ShutterMotion motion(const TrackedFrameOutput& out, const float* pose) const {
    return {call_.recent.last, pose, out.readout, call_.seconds};
  }

  void track(const std::int32_t* records, const GaussNewtonOptions& options, const TrackedPose& out) {
    track_gauss_newton(device_, call_.scene, records, call_.num_records, options, tracking_, out.pose, out.stats,
                       out.hessian);
  }

  void start(const TrackedFrameOutput& out) {
    const float* from = out.predicted;
    float* to = out.first.pose;
    for_each(device_, kPoseSize, [=] SPS_HOST_DEVICE(std::int64_t i) { to[i] = from[i]; });
  }

  // What was found first stands, its last statistics for all that the second pass would have, unless it is tracked
  // again from there.
  void decide(const TrackedFrameOutput& out) {
    constexpr std::int64_t kNumbers = TrackedPose::size(0);
    const PredictionLimits limits = call_.limits;
    const float *predicted = out.predicted, *first = out.first.pose, *readout = out.readout;
    const float* last = out.first.stats + kFrameStatSize * (call_.options.iterations - 1);
    float *outcome = out.outcome, *found = out.found.pose;
    const float seconds = call_.seconds;
    for_each(device_, TrackedPose::size(call_.again_iterations), [=] SPS_HOST_DEVICE(std::int64_t i) {
      found[i] = i < kNumbers ? first[i] : last[(i - kNumbers) % kFrameStatSize];
      if (i == 0) *outcome = static_cast<float>(frame_outcome(limits, predicted, first, *readout, seconds));
    });
  }

  Device device_;
  FrameTracking call_;
  Workspace memory_;
  std::int32_t* unbent_;  // records as the motion found first rectifies them
  char* tracking_;
};

}  // namespace spslam
