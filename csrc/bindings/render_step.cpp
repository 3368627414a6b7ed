#include "spslam/render_step.h"

#include "bindings/render_options.h"
#include "bindings/scene.h"

namespace spslam::bindings {
namespace {

constexpr char kName[] = "render_step";

// An output with at least `size` elements.
template <class T>
T* output(const Tensor& tensor, std::int64_t size, const char* name) {
  SPS_CHECK(tensor.numel() >= size, kName, ": ", name, " must have at least ", size, " elements, got ", tensor.numel());
  return mutable_data<T>(tensor);
}

// Gradients of a decoder, of the table that it reads, and the table's stamps, which may be left out; null: frozen.
struct DecoderOutput {
  DecoderOutput(const char* name, const std::vector<Tensor>& tensors, const MlpShape& decoder, std::int64_t rows,
                std::int64_t channels) {
    if (tensors.empty()) return;
    SPS_CHECK(tensors.size() == 2 || tensors.size() == 3, kName, ": ", name,
              " must be gradients of the decoder and of its table, and stamps");
    params = output<float>(tensors[0], decoder.num_params(), name);
    table = output<float>(tensors[1], rows * channels, name);
    if (tensors.size() == 3) stamps = output<std::int32_t>(tensors[2], rows, name);
  }

  float *params = nullptr, *table = nullptr;
  std::int32_t* stamps = nullptr;
};

void render_step(std::vector<Tensor> scene_tensors, std::vector<double> scene_scalars,
                 std::vector<std::int64_t> plane_layout, std::vector<Tensor> rays, std::vector<double> render_scalars,
                 std::vector<std::int64_t> render_integers, std::int64_t stamp, Tensor losses,
                 std::optional<Tensor> grad_poses, std::vector<Tensor> geometry, std::vector<Tensor> color) {
  SPS_CHECK(rays.size() == 3, kName, ": rays must be pixels, ray_frames and poses");
  const Tensor pixels = as_contiguous(rays[0]), ray_frames = as_contiguous(rays[1]), poses = as_contiguous(rays[2]);
  const std::int64_t num_rays = ray_frames.numel();
  SPS_CHECK(has_shape(ray_frames, {num_rays}) && has_shape(pixels, {num_rays, 3}), kName,
            ": ray_frames and pixels must have shapes [R] and [R, 3]");
  check_count(kName, "rays", num_rays, 0);
  SPS_CHECK(poses.dim() == 2 && poses.size(1) == kPoseSize, kName, ": poses must have shape [F, 7]");
  DeviceScope scope(losses);
  const SceneArgument scene(scene_tensors, scene_scalars, plane_layout);
  const RenderArgument render(kName, render_scalars, render_integers);
  const RayBatch batch{
      data<std::int32_t>(pixels), data<std::int32_t>(ray_frames), num_rays, data<float>(poses), poses.size(0),
      render.intrinsics};
  const std::int64_t num_texels = scene_tensors[5].numel() / kPlaneChannels;
  const DecoderOutput to_geometry("geometry", geometry, kGeometryDecoder, scene.view.num_voxels, kEmbeddingChannels);
  const DecoderOutput to_color("color", color, kColorDecoder, num_texels, kPlaneChannels);
  RenderGradients gradients{};
  gradients.losses = output<float>(losses, kLossTerms, "losses");
  if (grad_poses) gradients.poses = output<float>(*grad_poses, batch.num_frames * kPoseGradientSize, "grad_poses");
  gradients.embeddings = to_geometry.table;
  gradients.embedding_stamps = to_geometry.stamps;
  gradients.texels = to_color.table;
  gradients.texel_stamps = to_color.stamps;
  gradients.geometry_params = to_geometry.params;
  gradients.color_params = to_color.params;
  gradients.stamp = to_int32(kName, "stamp", stamp);
  const std::int64_t bytes = render_step_workspace_size(scope.context, scene.view, batch, render.options, gradients);
  Tensor workspace = empty(losses, {bytes}, ScalarType::Byte);
  spslam::render_step(scope.context, scene.view, batch, render.options, gradients, workspace.mutable_data_ptr());
}

}  // namespace

#ifndef SPS_CUDA
STABLE_TORCH_LIBRARY_FRAGMENT(spslam, m) {
  m.def("render_step(" SPS_SCENE_SCHEMA ", Tensor[] rays, " SPS_RENDER_SCHEMA
        ", int stamp, Tensor(a!) losses, Tensor(b!)? grad_poses, Tensor(c!)[] geometry, Tensor(d!)[] color) -> ()");
}
#endif

SPS_LIBRARY_IMPL(m) {
  m.impl("render_step", TORCH_BOX(&render_step));
}

}  // namespace spslam::bindings
