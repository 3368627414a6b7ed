// A whole mapping call: all iterations of the joint optimization of scene and poses (section III.D).
#pragma once

#include <cstdint>

#include "spslam/render_step.h"
#include "spslam/types/ray_source.h"

namespace spslam {

class LaunchGraph;

// One tensor of parameters [rows, channels] and its Adam moments. Without moments the parameters are frozen.
struct AdamState {
  float* param;
  float *exp_avg, *exp_avg_sq;  // null: frozen
  double learning_rate;
  std::int64_t first_step;  // 1-based, of the moments
};

// The same for a table of which each iteration changes a few rows.
struct AdamTable {
  AdamState state;
  // [rows, channels] sums of an iteration's gradients, zero before and after a call: float on the Cpu, std::int64_t on
  // Cuda, where integers make the sums independent of the order of additions.
  void* gradients;
  std::int32_t* stamps;  // [rows]
};

struct MapOptimization {
  SceneView scene;
  RaySource rays;  // its draw and its poses are those of the first iteration; the slots are the frames optimized
  Intrinsics intrinsics;
  RenderOptions options;  // of the first iteration
  AdamTable embeddings, texels;
  AdamState geometry_params, color_params;
  AdamState poses;         // [rows, 7]
  std::int64_t fixed_row;  // of the poses: kept, as the gauge of the reconstruction
  std::int64_t iterations;
  std::int32_t first_stamp;  // rows get first_stamp + iteration
  float* losses;             // [iterations, 5]
};

// Bytes of scratch that optimize_map needs.
template <class Device>
std::int64_t optimize_map_workspace_size(Device device, const MapOptimization& call);

// Changes the scene's tables, the decoders and the poses in place. Where `graph` is given (Cuda), the call runs as one
// CUDA graph, which is kept there.
template <class Device>
void optimize_map(Device device, const MapOptimization& call, void* workspace, LaunchGraph* graph);

}  // namespace spslam
