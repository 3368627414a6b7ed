// The ray kernel as the launches see it: whether it serves a step, and how it is launched.
#pragma once

#include "cuda/fused/arguments.cuh"
#include "cuda/launch_graph.h"

namespace spslam::fused {

// Whether the ray kernel serves such a step: not more than kMaxSamples samples a ray, tables at addresses that vectors
// can be read from.
bool covers(const SceneView& scene, const RenderOptions& options);

// Blocks of a launch over that many rays, each of which leaves one partial sum; 0 rays take one.
int num_blocks(Precision precision, bool train, std::int64_t num_rays);

// Arguments that a step's own do not tell: gradients, partials and pose_gradients are left empty.
RayStepArguments make_arguments(const SceneView& scene, const RaySource& rays, const Intrinsics& camera,
                                const RenderOptions& options);

// Power of two that turns gradients into integers; the larger the weights of the losses, the smaller.
float fixed_point_scale(const LossWeights& weights);

KernelLaunch ray_launch(Precision precision, bool train, const RayStepArguments& arguments);

}  // namespace spslam::fused
