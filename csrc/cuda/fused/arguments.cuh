// Arguments of the ray kernel. Passed by value, so that a graph's kernels are updated without a new capture.
#pragma once

#include "kernels/ray_source.h"
#include "spslam/render_step.h"

namespace spslam::fused {

// Most samples per ray: two for each lane of a warp.
constexpr int kMaxSamples = 64;

// Gradients of a table's rows, summed as fixed-point integers; null: frozen.
struct TableSums {
  std::int64_t* sums;
  std::int32_t* stamps;  // or null
};

struct RayStepArguments {
  SceneView scene;
  float inverse_voxel, inverse_cell;
  bool planes_cover;  // no plane is empty
  RaySource rays;
  Intrinsics camera;
  RaySampling<float> sampling;
  PhiloxKey key;
  LossWeights scale;  // weights of the terms over the number of rays
  bool cosine_targets;
  bool color, pose;                    // whether color is rendered, whether poses have a gradient
  bool geometry_params, color_params;  // whether the decoders have one
  TableSums embeddings, texels;
  float fixed_point_scale;
  std::int32_t stamp;
  float* partials;        // [blocks, kPartialSize], or kTrackingPartialSize where the scene is frozen
  float* pose_gradients;  // [num_rays, kPoseGradientStride]; null where the scene is frozen
};

// Sums of one block: parameters of both decoders, then the four loss terms.
constexpr int kLossSums = 4;
constexpr int kNumParams = static_cast<int>(kGeometryDecoder.num_params() + kColorDecoder.num_params());
constexpr int kPartialLosses = kNumParams, kPartialSize = (kPartialLosses + kLossSums + 31) / 32 * 32;
// The same where the scene is frozen: the loss terms, then d L / d pose.
constexpr int kTrackingSums = kLossSums + kPoseGradientSize, kTrackingPartialSize = 16;
// d L / d pose of one ray, padded.
constexpr int kPoseGradientStride = 8;

}  // namespace spslam::fused
