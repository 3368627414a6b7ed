// Scratch memory of render_step where it is composed of the launches of the single ops.
#pragma once

#include "launch/workspace.h"
#include "spslam/decoders.h"
#include "spslam/interpolation.h"
#include "spslam/render_step.h"
#include "spslam/volume_rendering.h"

namespace spslam {

// Rows of the texel table that the planes reach.
inline std::int64_t plane_rows(const TriPlaneLayout& layout) {
  std::int64_t rows = 0;
  for (const PlaneLayout& plane : layout.planes) {
    const std::int64_t end = plane.offset + std::int64_t{plane.size_u} * plane.size_v;
    rows = end > rows ? end : rows;
  }
  return rows;
}

// Scratch of one step: R rays, N = R * S samples.
struct RenderStepBuffers {
  std::int64_t bytes;
  Vec3<float>*origin, *direction;                           // [R] world
  float *depth, *target_color, *foreshortening;             // [R], [R, 3], [R]
  float* t;                                                 // [N]
  Vec3<float>* points;                                      // [N]
  bool* valid;                                              // [N]
  std::int32_t* corners;                                    // [N, 8]
  float *local, *feature, *x, *sdf;                         // [N, 3], [N, 8], [N, 11], [N]
  float *texel, *rgb;                                       // [N, 32], [N, 3]
  float *color, *rendered_depth, *weights;                  // [R, 3], [R], [N]
  bool* rendered;                                           // [R]
  float *term_weights, *terms, *loss_workspace;             // [4], [4]
  float *grad_color, *grad_depth;                           // [R, 3], [R]
  float *grad_sdf, *grad_sdf_rendered, *grad_rgb, *grad_t;  // [N], [N], [N, 3], [N]
  float *grad_x, *grad_feature, *grad_local;                // [N, 11], [N, 8], [N, 3]
  float *grad_texel, *grad_points;                          // [N, 32], [N, 3]
  float* mlp_workspace;
  float* grad_table;
  std::int64_t* scatter_words;
  float* pose_gradients;  // [R, 6]

  template <class Device>
  RenderStepBuffers(Device device, void* base, const SceneView& scene, const RayBatch& rays,
                    const RenderOptions& options) {
    const std::int64_t r = rays.num_rays, n = r * options.sampling.num_samples();
    const auto larger = [](std::int64_t a, std::int64_t b) { return a > b ? a : b; };
    const std::int64_t table_size =
        larger(scene.num_voxels * kEmbeddingChannels, plane_rows(scene.planes) * kPlaneChannels);
    Workspace memory(base);
    origin = memory.take<Vec3<float>>(r), direction = memory.take<Vec3<float>>(r);
    depth = memory.take<float>(r), target_color = memory.take<float>(3 * r), foreshortening = memory.take<float>(r);
    t = memory.take<float>(n), points = memory.take<Vec3<float>>(n), valid = memory.take<bool>(n);
    corners = memory.take<std::int32_t>(kCellCorners * n);
    local = memory.take<float>(3 * n), feature = memory.take<float>(kEmbeddingChannels * n);
    x = memory.take<float>(kGeometryDecoder.input * n), sdf = memory.take<float>(n);
    texel = memory.take<float>(kPlaneChannels * n), rgb = memory.take<float>(3 * n);
    color = memory.take<float>(3 * r), rendered_depth = memory.take<float>(r), weights = memory.take<float>(n);
    rendered = memory.take<bool>(r);
    term_weights = memory.take<float>(4), terms = memory.take<float>(4);
    loss_workspace = memory.take<float>(rendering_losses_workspace(r));
    grad_color = memory.take<float>(3 * r), grad_depth = memory.take<float>(r);
    grad_sdf = memory.take<float>(n), grad_sdf_rendered = memory.take<float>(n);
    grad_rgb = memory.take<float>(3 * n), grad_t = memory.take<float>(n);
    grad_x = memory.take<float>(kGeometryDecoder.input * n), grad_feature = memory.take<float>(kEmbeddingChannels * n);
    grad_local = memory.take<float>(3 * n);
    grad_texel = memory.take<float>(kPlaneChannels * n), grad_points = memory.take<float>(3 * n);
    mlp_workspace = memory.take<float>(larger(mlp_backward_workspace_size(device, kGeometryDecoder, n),
                                              mlp_backward_workspace_size(device, kColorDecoder, n)));
    grad_table = memory.take<float>(table_size);
    scatter_words = memory.take<std::int64_t>(scatter_workspace_words<Device>(table_size));
    pose_gradients = memory.take<float>(kPoseGradientSize * r);
    bytes = memory.used();
  }
};

}  // namespace spslam
