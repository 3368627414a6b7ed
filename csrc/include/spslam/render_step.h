// One step of tracking or mapping, fused: rays in, losses and gradients out (sections III.B and III.C).
#pragma once

#include <cstdint>

#include "core/device.h"
#include "core/philox.h"
#include "spslam/scene_view.h"
#include "spslam/types/ray_sampling.h"

namespace spslam {

constexpr int kLossTerms = 5;         // total, then the four terms of the objective, not weighted
constexpr int kPoseGradientSize = 6;  // d L / d translation, d L / d rotation (left increment about the camera center)

struct RayBatch {
  const std::int32_t* pixels;      // [num_rays, 3] packed, see kernels/pixel_record.h
  const std::int32_t* ray_frames;  // [num_rays] row of poses, not decreasing
  std::int64_t num_rays;
  const float* poses;  // [num_frames, 7] T_world_camera: quaternion (w, x, y, z), translation (m)
  std::int64_t num_frames;
  Intrinsics intrinsics;
};

struct LossWeights {
  float rgb, depth, free_space, sdf;
};

// Arithmetic of the decoders in the fused kernels on CUDA: tf32 products on tensor cores, where the device has them, or
// float throughout. The CPU always computes in float.
enum class Precision : std::int32_t { kTf32 = 0, kFp32 = 1 };

struct RenderOptions {
  RaySampling<float> sampling;
  PhiloxKey key;
  LossWeights weights;
  bool cosine_targets;  // distances to the surface's tangent plane, not along the ray
  Precision precision;
};

// Where results go. Losses and dense gradients are overwritten. Rows of tables are added to and stamped; a null table,
// or null decoder, is frozen.
struct RenderGradients {
  float* losses;  // [5]
  float* poses;   // [num_frames, 6] or null
  float* embeddings;
  std::int32_t* embedding_stamps;
  float* texels;
  std::int32_t* texel_stamps;
  float* geometry_params;
  float* color_params;
  std::int32_t stamp;
};

// Bytes of scratch that render_step needs.
template <class Device>
std::int64_t render_step_workspace_size(Device device, const SceneView& scene, const RayBatch& rays,
                                        const RenderOptions& options, const RenderGradients& gradients);

template <class Device>
void render_step(Device device, const SceneView& scene, const RayBatch& rays, const RenderOptions& options,
                 const RenderGradients& gradients, void* workspace);

}  // namespace spslam
