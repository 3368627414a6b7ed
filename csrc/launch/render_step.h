// render_step composed of the launches of the single ops, for any device. One element function or op after the other
// through global memory, and as deterministic as these.
#pragma once

#include "core/for_each.h"
#include "kernels/interpolation.h"
#include "kernels/pixel_record.h"
#include "kernels/ray_pose_gradient.h"
#include "kernels/ray_sampling.h"
#include "kernels/voxel_hash.h"
#include "launch/render_step_buffers.h"
#include "spslam/ray_sampling.h"

namespace spslam {

// All members are public: nvcc takes no device lambda from a private function.
template <class Device>
struct RenderStepLaunch {
  RenderStepLaunch(Device device, const SceneView& scene, const RayBatch& rays, const RenderOptions& options,
                   const RenderGradients& out, const RenderStepBuffers& buffers)
      : device_(device),
        scene_(scene),
        rays_(rays),
        options_(options),
        out_(out),
        b_(buffers),
        samples_(options.sampling.num_samples()),
        n_(rays.num_rays * samples_),
        color_(options.weights.rgb != 0.0f),
        inverse_voxel_(1.0f / scene.voxel_size),
        inverse_cell_(1.0f / scene.plane_cell_size) {}

  void run() {
    load_rays();
    place_samples();
    decode();
    render();
    store_losses();
    backward();
  }

  void load_rays() {
    const RayBatch rays = rays_;
    const RenderStepBuffers b = b_;
    for_each(device_, rays.num_rays, [=] SPS_HOST_DEVICE(std::int64_t r) {
      const Pixel pixel = unpack_pixel(rays.pixels + kPixelWords * r);
      const std::int32_t frame = rays.ray_frames[r];
      const bool known = frame >= 0 && frame < rays.num_frames;
      const Intrinsics& k = rays.intrinsics;
      const Pose<float> pose = known ? load_pose(rays.poses + 7 * static_cast<std::int64_t>(frame)) : Pose<float>{};
      b.origin[r] = pose.translation;
      b.direction[r] = pose.rotation * pixel_ray(pixel, k);
      b.depth[r] = known && has_depth(pixel.depth) ? pixel.depth : 0.0f;
      b.foreshortening[r] = pixel.foreshortening;
      for (int c = 0; c < 3; ++c) b.target_color[3 * r + c] = pixel.color[c];
    });
  }

  void place_samples() {
    sample_along_rays(device_, options_.key, options_.sampling, b_.depth, rays_.num_rays, b_.t);
    const SceneView scene = scene_;
    const RenderStepBuffers b = b_;
    const std::int64_t samples = samples_;
    const float inverse_voxel = inverse_voxel_;
    for_each(device_, n_, [=] SPS_HOST_DEVICE(std::int64_t i) {
      const std::int64_t ray = i / samples;
      const Vec3<float> point = b.origin[ray] + b.t[i] * b.direction[ray];
      const Cell<float> cell = find_cell(scene.table, scene.corner_ids, scene.num_voxels, inverse_voxel * point);
      const bool valid = cell.corner_ids && b.depth[ray] > 0 && complete_cell(cell.corner_ids, scene.num_voxels);
      b.points[i] = point;
      b.valid[i] = valid;
      for (int k = 0; k < kCellCorners; ++k) b.corners[kCellCorners * i + k] = valid ? cell.corner_ids[k] : kNoVoxel;
      b.local[3 * i] = cell.local.x;
      b.local[3 * i + 1] = cell.local.y;
      b.local[3 * i + 2] = cell.local.z;
    });
  }

  // SDF, and color where wanted, of every sample: 1 and 0 where there is nothing.
  void decode() {
    trilinear_interpolate(device_, scene_.embeddings, scene_.num_voxels, kEmbeddingChannels, b_.corners, b_.local, n_,
                          b_.feature);
    const SceneView scene = scene_;
    const RenderStepBuffers b = b_;
    constexpr std::int64_t kInput = kGeometryDecoder.input;
    for_each(device_, n_, [=] SPS_HOST_DEVICE(std::int64_t i) {
      const Vec3<float> p = b.points[i];
      const float position[3] = {p.x - scene.origin[0], p.y - scene.origin[1], p.z - scene.origin[2]};
      for (int k = 0; k < 3; ++k) b.x[kInput * i + k] = b.valid[i] ? scene.position_scale * position[k] : 0.0f;
      for (int k = 0; k < kEmbeddingChannels; ++k) b.x[kInput * i + 3 + k] = b.feature[kEmbeddingChannels * i + k];
    });
    mlp(device_, kGeometryDecoder, b_.x, n_, scene_.geometry_params, b_.mlp_workspace, b_.sdf);
    for_each(device_, n_, [=] SPS_HOST_DEVICE(std::int64_t i) { b.sdf[i] = b.valid[i] ? b.sdf[i] : 1.0f; });
    if (!color_) return fill_zero(3 * n_, b_.rgb);
    tri_plane_interpolate(device_, scene_.texels, num_texels(), kPlaneChannels, &b_.points->x, n_, inverse_cell_,
                          scene_.planes, b_.texel);
    mlp(device_, kColorDecoder, b_.texel, n_, scene_.color_params, b_.mlp_workspace, b_.rgb);
  }

  void render() {
    volume_render(device_, table(), b_.rgb, options_.sampling.truncation, b_.color, b_.rendered_depth, b_.weights);
    const RenderStepBuffers b = b_;
    const LossWeights w = options_.weights;
    const std::int64_t samples = samples_;
    for_each(device_, rays_.num_rays, [=] SPS_HOST_DEVICE(std::int64_t r) {
      float sum = 0.0f;
      for (std::int64_t i = r * samples; i < (r + 1) * samples; ++i) sum += b.weights[i];
      b.rendered[r] = sum > 0.0f;
    });
    for_each(device_, 1, [=] SPS_HOST_DEVICE(std::int64_t) {
      const float weights[4] = {w.rgb, w.depth, w.free_space, w.sdf};
      for (int k = 0; k < 4; ++k) b.term_weights[k] = weights[k];
    });
    rendering_losses(device_, table(), loss_inputs(), b_.terms, b_.loss_workspace);
  }

  void store_losses() {
    const RenderStepBuffers b = b_;
    const bool color = color_, any = rays_.num_rays > 0;
    float* losses = out_.losses;
    for_each(device_, 1, [=] SPS_HOST_DEVICE(std::int64_t) {
      losses[0] = 0.0f;
      for (int k = 0; k < 4; ++k) {
        losses[1 + k] = any && (color || k > 0) ? b.terms[k] : 0.0f;
        losses[0] += b.term_weights[k] * losses[1 + k];
      }
    });
  }

  void backward() {
    rendering_losses_backward(device_, table(), loss_inputs(), b_.term_weights, b_.grad_color, b_.grad_depth,
                              b_.grad_sdf, b_.grad_t);
    volume_render_backward(device_, table(), b_.rgb, b_.weights, options_.sampling.truncation, b_.grad_color,
                           b_.grad_depth, static_cast<const float*>(nullptr), b_.grad_sdf_rendered, b_.grad_rgb,
                           b_.grad_t);
    const RenderStepBuffers b = b_;
    for_each(device_, n_, [=] SPS_HOST_DEVICE(std::int64_t i) {
      b.grad_sdf[i] = b.valid[i] ? b.grad_sdf[i] + b.grad_sdf_rendered[i] : 0.0f;
    });
    color_backward();
    geometry_backward();
    if (out_.poses) pose_backward();
  }

  void color_backward() {
    if (!color_) {
      if (out_.color_params) fill_zero(kColorDecoder.num_params(), out_.color_params);
      return fill_zero(3 * n_, b_.grad_points);
    }
    mlp_backward(device_, kColorDecoder, b_.grad_rgb, b_.texel, n_, scene_.color_params, b_.mlp_workspace,
                 b_.grad_texel, out_.color_params);
    tri_plane_interpolate_backward(device_, b_.grad_texel, scene_.texels, num_texels(), kPlaneChannels, &b_.points->x,
                                   n_, inverse_cell_, scene_.planes, out_.texels ? b_.grad_table : nullptr,
                                   b_.grad_points, b_.scatter_words);
    if (!out_.texels) return;
    add(num_texels() * kPlaneChannels, out_.texels);
    if (out_.texel_stamps && covered()) stamp_texels();
  }

  void geometry_backward() {
    if (!out_.poses && !out_.embeddings && !out_.geometry_params) return;
    mlp_backward(device_, kGeometryDecoder, b_.grad_sdf, b_.x, n_, scene_.geometry_params, b_.mlp_workspace, b_.grad_x,
                 out_.geometry_params);
    const RenderStepBuffers b = b_;
    constexpr std::int64_t kInput = kGeometryDecoder.input;
    for_each(device_, n_ * kEmbeddingChannels, [=] SPS_HOST_DEVICE(std::int64_t i) {
      b.grad_feature[i] = b.grad_x[i / kEmbeddingChannels * kInput + 3 + i % kEmbeddingChannels];
    });
    trilinear_interpolate_backward(device_, b_.grad_feature, scene_.embeddings, scene_.num_voxels, kEmbeddingChannels,
                                   b_.corners, b_.local, n_, out_.embeddings ? b_.grad_table : nullptr, b_.grad_local,
                                   b_.scatter_words);
    if (!out_.embeddings) return;
    add(scene_.num_voxels * kEmbeddingChannels, out_.embeddings);
    if (out_.embedding_stamps) stamp_embeddings();
  }

  // Each ray's gradient by the pose it starts from, then sums over the rays of a frame, in their order.
  void pose_backward() {
    const RenderStepBuffers b = b_;
    const RayBatch rays = rays_;
    const std::int64_t samples = samples_;
    const float inverse_voxel = inverse_voxel_, position_scale = scene_.position_scale;
    constexpr std::int64_t kInput = kGeometryDecoder.input;
    for_each(device_, rays.num_rays, [=] SPS_HOST_DEVICE(std::int64_t r) {
      RayPoseGradient sums{};
      for (std::int64_t i = r * samples; i < (r + 1) * samples; ++i) {
        if (!b.valid[i]) continue;
        const float *cell = b.grad_local + 3 * i, *x = b.grad_x + kInput * i, *color = b.grad_points + 3 * i;
        const Vec3<float> by_point = inverse_voxel * Vec3<float>{cell[0], cell[1], cell[2]} +
                                     position_scale * Vec3<float>{x[0], x[1], x[2]} +
                                     Vec3<float>{color[0], color[1], color[2]};
        add_point_gradient(by_point, b.t[i], sums);
      }
      const PoseGradient gradient = pose_gradient(sums, b.direction[r]);
      for (int k = 0; k < kPoseGradientSize; ++k) b.pose_gradients[kPoseGradientSize * r + k] = gradient.values[k];
    });
    float* poses = out_.poses;
    for_each(device_, rays.num_frames * kPoseGradientSize, [=] SPS_HOST_DEVICE(std::int64_t i) {
      double sum = 0.0;
      for (std::int64_t r = 0; r < rays.num_rays; ++r) {
        if (rays.ray_frames[r] != i / kPoseGradientSize) continue;
        sum += b.pose_gradients[kPoseGradientSize * r + i % kPoseGradientSize];
      }
      poses[i] = static_cast<float>(sum);
    });
  }

  void stamp_embeddings() {
    const RenderStepBuffers b = b_;
    std::int32_t *stamps = out_.embedding_stamps, stamp = out_.stamp;
    for_each(device_, n_ * kCellCorners, [=] SPS_HOST_DEVICE(std::int64_t i) {
      if (b.corners[i] != kNoVoxel) stamps[b.corners[i]] = stamp;
    });
  }

  void stamp_texels() {
    const RenderStepBuffers b = b_;
    const TriPlaneLayout planes = scene_.planes;
    const float inverse_cell = inverse_cell_;
    std::int32_t *stamps = out_.texel_stamps, stamp = out_.stamp;
    for_each(device_, n_, [=] SPS_HOST_DEVICE(std::int64_t i) {
      for (int p = 0; b.weights[i] != 0.0f && p < 3; ++p) {
        const PlaneCell<float> cell = tri_plane_cell(b.points[i], inverse_cell, planes.planes[p], p);
        for (std::int64_t row : cell.rows) stamps[row] = stamp;
      }
    });
  }

  void add(std::int64_t count, float* out) {
    const float* term = b_.grad_table;
    for_each(device_, count, [=] SPS_HOST_DEVICE(std::int64_t i) { out[i] += term[i]; });
  }

  void fill_zero(std::int64_t count, float* out) {
    for_each(device_, count, [=] SPS_HOST_DEVICE(std::int64_t i) { out[i] = 0.0f; });
  }

  SampleTable<float> table() const { return {b_.sdf, b_.t, b_.valid, rays_.num_rays, samples_}; }

  LossInputs<float> loss_inputs() const {
    return {b_.color,
            b_.rendered_depth,
            b_.rendered,
            b_.target_color,
            b_.depth,
            b_.foreshortening,
            options_.sampling.truncation,
            options_.cosine_targets};
  }

  bool covered() const {
    bool empty = false;
    for (const PlaneLayout& plane : scene_.planes.planes) empty |= empty_plane(plane);
    return !empty;
  }

  std::int64_t num_texels() const { return plane_rows(scene_.planes); }

  const Device device_;
  const SceneView& scene_;
  const RayBatch& rays_;
  const RenderOptions& options_;
  const RenderGradients& out_;
  const RenderStepBuffers& b_;
  const std::int64_t samples_, n_;
  const bool color_;
  const float inverse_voxel_, inverse_cell_;
};

}  // namespace spslam
