// A whole tracking call with Adam on quaternion and translation, the scene frozen (section III.D).
#pragma once

#include <cstdint>

#include "spslam/render_step.h"
#include "spslam/types/ray_source.h"

namespace spslam {

class LaunchGraph;

struct PoseTracking {
  SceneView scene;
  RaySource rays;  // one slot; its draw is that of the first iteration, its poses are not read
  Intrinsics intrinsics;
  RenderOptions options;  // of the first iteration
  std::int64_t iterations;
  double rotation_rate, translation_rate;
  const float* start;  // [7]
  float* best;         // [7] the pose with the least total loss; the start where every loss is NaN
  float* losses;       // [iterations, 5]
};

// Bytes of scratch that track_adam needs.
template <class Device>
std::int64_t track_adam_workspace_size(Device device, const PoseTracking& call);

// Where `graph` is given (Cuda), the call runs as one CUDA graph, which is kept there.
template <class Device>
void track_adam(Device device, const PoseTracking& call, void* workspace, LaunchGraph* graph);

}  // namespace spslam
