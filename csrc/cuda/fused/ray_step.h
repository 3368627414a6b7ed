// Host interface of the ray kernel: whether it supports a step, and how it is launched.
#pragma once

#include "cuda/fused/arguments.cuh"
#include "cuda/launch_graph.h"

namespace spslam::fused {

// Whether the ray kernel supports such a step: at most kMaxSamples samples per ray, tables aligned for vector loads.
bool covers(const SceneView& scene, const RenderOptions& options);

// Blocks of a launch over that many rays, each of which leaves one partial sum; 0 rays take one.
int num_blocks(Precision precision, bool train, std::int64_t num_rays);

// Arguments of a step; gradients, partials and pose_gradients are left empty.
RayStepArguments make_arguments(const SceneView& scene, const RaySource& rays, const Intrinsics& camera,
                                const RenderOptions& options);

// Power of two that turns gradients into integers; the larger the weights of the losses, the smaller.
float fixed_point_scale(const LossWeights& weights);

KernelLaunch ray_launch(Precision precision, bool train, const RayStepArguments& arguments);

}  // namespace spslam::fused
