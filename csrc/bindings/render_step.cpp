#include "spslam/render_step.h"

#include "bindings/render_options.h"
#include "bindings/scene.h"

namespace spslam::bindings {
namespace {

using OptionalTensor = std::optional<Tensor>;

// An output that may be absent, with at least `size` elements.
template <class T>
T* output(const OptionalTensor& tensor, std::int64_t size, const char* name) {
  if (!tensor.has_value()) return nullptr;
  SPS_CHECK(tensor->numel() >= size, "render_step: ", name, " must have at least ", size, " elements, got ",
            tensor->numel());
  return mutable_data<T>(*tensor);
}

void render_step(std::vector<Tensor> scene_tensors, std::vector<double> scene_scalars,
                 std::vector<std::int64_t> plane_layout, Tensor pixels, Tensor ray_frames, Tensor poses,
                 SPS_RENDER_OPTIONS_PARAMETERS, Tensor losses, OptionalTensor grad_poses,
                 OptionalTensor grad_embeddings, OptionalTensor embedding_stamps, OptionalTensor grad_texels,
                 OptionalTensor texel_stamps, OptionalTensor grad_geometry, OptionalTensor grad_color,
                 std::int64_t stamp, std::int64_t precision) {
  const std::int64_t num_rays = ray_frames.numel();
  SPS_CHECK(has_shape(ray_frames, {num_rays}) && has_shape(pixels, {num_rays, 3}),
            "render_step: ray_frames and pixels must have shapes [R] and [R, 3]");
  check_count("render_step", "rays", num_rays, 0);
  SPS_CHECK(poses.dim() == 2 && poses.size(1) == 7, "render_step: poses must have shape [F, 7]");
  DeviceScope scope(losses);
  const SceneArgument scene(scene_tensors, scene_scalars, plane_layout);
  const SceneView& view = scene.view;
  pixels = torch::stable::contiguous(pixels);
  ray_frames = torch::stable::contiguous(ray_frames);
  poses = torch::stable::contiguous(poses);
  const std::int64_t num_texels = scene_tensors[5].numel() / kPlaneChannels;
  const RayBatch rays{data<std::int32_t>(pixels),
                      data<std::int32_t>(ray_frames),
                      num_rays,
                      data<float>(poses),
                      poses.size(0),
                      load_intrinsics("render_step", intrinsics)};
  const RenderOptions options =
      load_options("render_step", num_uniform, num_surface, near, far, truncation, cosine_targets, weights,
                   philox_key(seed, stream, frame, iteration), precision);
  const RenderGradients gradients{
      output<float>(losses, kLossTerms, "losses"),
      output<float>(grad_poses, rays.num_frames * kPoseGradientSize, "grad_poses"),
      output<float>(grad_embeddings, view.num_voxels * kEmbeddingChannels, "grad_embeddings"),
      output<std::int32_t>(embedding_stamps, view.num_voxels, "embedding_stamps"),
      output<float>(grad_texels, num_texels * kPlaneChannels, "grad_texels"),
      output<std::int32_t>(texel_stamps, num_texels, "texel_stamps"),
      output<float>(grad_geometry, kGeometryDecoder.num_params(), "grad_geometry"),
      output<float>(grad_color, kColorDecoder.num_params(), "grad_color"),
      to_int32("render_step", "stamp", stamp)};
  const std::int64_t bytes = render_step_workspace_size(scope.context, view, rays, options, gradients);
  Tensor workspace = empty(losses, {bytes}, ScalarType::Byte);
  spslam::render_step(scope.context, view, rays, options, gradients, workspace.mutable_data_ptr());
}

}  // namespace

#ifndef SPS_CUDA
STABLE_TORCH_LIBRARY_FRAGMENT(spslam, m) {
  m.def("render_step(" SPS_SCENE_SCHEMA ", Tensor pixels, Tensor ray_frames, Tensor poses, " SPS_RENDER_OPTIONS_SCHEMA
        ", Tensor(a!) losses, Tensor(b!)? grad_poses, Tensor(c!)? grad_embeddings, Tensor(d!)? embedding_stamps, "
        "Tensor(e!)? grad_texels, Tensor(f!)? texel_stamps, Tensor(g!)? grad_geometry, Tensor(h!)? grad_color, "
        "int stamp, int precision=0) -> ()");
}
#endif

SPS_LIBRARY_IMPL(m) {
  m.impl("render_step", TORCH_BOX(&render_step));
}

}  // namespace spslam::bindings
