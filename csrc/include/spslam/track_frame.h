// One frame of a moving camera in one go: predicted, rectified, tracked and, where its motion turned out otherwise and
// had bent it, rectified and tracked again. The host is asked nothing in between.
#pragma once

#include "spslam/gauss_newton.h"
#include "spslam/rolling_shutter.h"

namespace spslam {

// What the first pass says of a frame, as the number that is written.
enum class FrameOutcome {
  kSettled,  // the pose of the first pass stands
  kBent,     // the frame was rectified and tracked again
  kFar,      // so far from the prediction that the host decides; not tracked again
};

// By how much a pose may differ from the predicted one, m and rad.
struct PredictionLimits {
  double bent_turn;  // during the time that a frame's readout takes; more bends it
  double far_way, far_turn;
};

struct FrameTracking {
  SceneView scene;
  GaussNewtonOptions options;     // of the first pass
  std::int64_t again_iterations;  // of the second one, which begins near: with kernel_end, and keyframes from the start
  const std::int32_t* records;    // [num_records, 3] as they were read
  std::int64_t num_records;
  FrameImages images;    // as they were read
  RecentMotion recent;   // of the two frames before
  const float* readout;  // [1] s
  float seconds;         // from the last frame to this one
  ShutterCamera camera, image_camera;
  PredictionLimits limits;
};

// Parts of what tracking finds.
struct TrackedPose {
  float *pose, *hessian, *stats;  // [7], [36], [iterations, kFrameStatSize]: of the pass that found it

  // In one piece, in this order.
  explicit TrackedPose(float* numbers) : pose(numbers), hessian(pose + kPoseSize), stats(hessian + kHessianSize) {}

  static constexpr std::int64_t size(std::int64_t iterations) {
    return kPoseSize + kHessianSize + iterations * kFrameStatSize;
  }
};

struct TrackedFrameOutput {
  float* outcome;                   // [1] FrameOutcome
  float* predicted;                 // [7]
  float* readout;                   // [1] that counted for it
  TrackedPose first, found;         // by the first pass, and in the end
  std::int32_t* predicted_records;  // [num_records, 3] as the predicted motion rectifies them
  ShutterFrame rectified;           // by the pose found
};

template <class Device>
std::int64_t track_frame_workspace_size(Device device, const FrameTracking& call);

template <class Device>
void track_frame(Device device, const FrameTracking& call, void* workspace, const TrackedFrameOutput& out);

}  // namespace spslam
