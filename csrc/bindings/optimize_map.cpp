#include "spslam/optimize_map.h"

#include "bindings/launch_graph.h"
#include "bindings/render_options.h"
#include "bindings/scene.h"

namespace spslam::bindings {
namespace {

constexpr char kName[] = "optimize_map_";

#ifdef SPS_CUDA
using GradientSum = std::int64_t;
#else
using GradientSum = float;
#endif

void check_size(const Tensor& tensor, std::int64_t size, const char* name) {
  SPS_CHECK(tensor.numel() >= size, kName, ": ", name, " must have at least ", size, " elements, got ", tensor.numel());
}

// Moments [exp_avg, exp_avg_sq] of a tensor of parameters; none: frozen.
AdamState load_state(const Tensor& param, const std::vector<Tensor>& moments, std::int64_t size, double rate,
                     const char* name) {
  if (moments.empty()) return {};
  SPS_CHECK(moments.size() >= 2, kName, ": ", name, " must be exp_avg and exp_avg_sq");
  check_size(param, size, name);
  check_size(moments[0], size, name);
  check_size(moments[1], size, name);
  return {mutable_data<float>(param), mutable_data<float>(moments[0]), mutable_data<float>(moments[1]), rate};
}

// [exp_avg, exp_avg_sq, gradients, stamps] of a table.
AdamTable load_table(const Tensor& param, const std::vector<Tensor>& tensors, std::int64_t rows, std::int64_t channels,
                     double rate, const char* name) {
  if (tensors.empty()) return {};
  SPS_CHECK(tensors.size() == 4, kName, ": ", name, " must be exp_avg, exp_avg_sq, gradients and stamps");
  check_size(tensors[2], rows * channels, name);
  check_size(tensors[3], rows, name);
  return {load_state(param, tensors, rows * channels, rate, name), mutable_data<GradientSum>(tensors[2]),
          mutable_data<std::int32_t>(tensors[3])};
}

// The frames on the kernel's device. A copy of so few numbers is taken by the driver at once: nothing waits.
Tensor frames_on_device(const Tensor& frames, const Tensor& like, std::int64_t rows, const Context& context) {
  Tensor list = contiguous(frames);
#ifdef SPS_CUDA
  if (list.is_cuda()) return list;
#endif
  const std::int64_t* at = data<std::int64_t>(list);
  for (std::int64_t i = 0; i < list.numel(); ++i) {
    SPS_CHECK(at[i] >= 0 && at[i] < rows, kName, ": frames must be in [0, ", rows, "), got ", at[i]);
  }
#ifdef SPS_CUDA
  Tensor copy = empty(like, {list.numel()}, ScalarType::Long);
  STD_CUDA_CHECK(cudaMemcpyAsync(copy.mutable_data_ptr(), at, list.numel() * sizeof(std::int64_t),
                                 cudaMemcpyHostToDevice, static_cast<cudaStream_t>(context.stream)));
  return copy;
#else
  (void)like, (void)context;
  return list;
#endif
}

void optimize_map_(std::vector<Tensor> scene_tensors, std::vector<double> scene_scalars,
                   std::vector<std::int64_t> plane_layout, Tensor records, Tensor poses, Tensor frames,
                   SPS_RENDER_OPTIONS_PARAMETERS, std::int64_t pixel_stream, std::int64_t num_pixels,
                   std::int64_t iterations, std::int64_t fixed_frame, std::vector<Tensor> embeddings,
                   std::vector<Tensor> texels, std::vector<Tensor> geometry_params, std::vector<Tensor> color_params,
                   std::vector<Tensor> pose_moments, std::vector<double> rates, std::int64_t first_step,
                   std::int64_t first_stamp, Tensor losses, std::int64_t precision, std::int64_t graph) {
  SPS_CHECK(records.dim() == 3 && records.size(1) >= 1 && records.size(2) == 3, kName,
            ": records must have shape [F, P, 3] with P >= 1");
  SPS_CHECK(poses.dim() == 2 && poses.size(0) == records.size(0) && poses.size(1) == 7, kName,
            ": poses must have shape [F, 7]");
  SPS_CHECK(frames.dim() == 1 && frames.numel() >= 1, kName, ": frames must have shape [n] with n >= 1");
  check_count(kName, "num_pixels", num_pixels);
  check_count(kName, "iterations", iterations);
  check_count(kName, "first_step", first_step);
  to_int32(kName, "first_stamp", first_stamp);
  to_int32(kName, "last stamp", first_stamp + iterations - 1);
  SPS_CHECK(rates.size() == 5, kName, ": rates must be five numbers");
  check_size(losses, kLossTerms * iterations, "losses");
  DeviceScope scope(poses);
  const SceneArgument scene(scene_tensors, scene_scalars, plane_layout);
  const std::int64_t num_texels = scene_tensors[5].numel() / kPlaneChannels;
  records = contiguous(records);
  frames = frames_on_device(frames, poses, poses.size(0), scope.context);
  MapOptimization call{};
  call.scene = scene.view;
  call.rays.records = data<std::int32_t>(records);
  call.rays.records_per_row = records.size(1);
  call.rays.draw = philox_key(seed, pixel_stream, frame, iteration);
  call.rays.slot_rows = data<std::int64_t>(frames);
  call.rays.num_rays = num_pixels;
  call.rays.num_slots = frames.numel();
  call.rays.poses = mutable_data<float>(poses);
  call.intrinsics = load_intrinsics(kName, intrinsics);
  call.options = load_options(kName, num_uniform, num_surface, near, far, truncation, cosine_targets, weights,
                              philox_key(seed, stream, frame, iteration), precision);
  call.embeddings =
      load_table(scene_tensors[3], embeddings, scene.view.num_voxels, kEmbeddingChannels, rates[0], "embeddings");
  call.texels = load_table(scene_tensors[5], texels, num_texels, kPlaneChannels, rates[1], "texels");
  call.geometry_params =
      load_state(scene_tensors[4], geometry_params, kGeometryDecoder.num_params(), rates[2], "geometry_params");
  call.color_params = load_state(scene_tensors[6], color_params, kColorDecoder.num_params(), rates[3], "color_params");
  call.poses = load_state(poses, pose_moments, poses.numel(), rates[4], "pose_moments");
  call.fixed_row = fixed_frame;
  call.iterations = iterations;
  call.first_step = first_step;
  call.first_stamp = static_cast<std::int32_t>(first_stamp);
  call.losses = mutable_data<float>(losses);
  Tensor workspace = empty(losses, {optimize_map_workspace_size(scope.context, call)}, ScalarType::Byte);
  optimize_map(scope.context, call, workspace.mutable_data_ptr(), find_launch_graph(graph));
}

}  // namespace

#ifndef SPS_CUDA
STABLE_TORCH_LIBRARY_FRAGMENT(spslam, m) {
  m.def(
      "optimize_map_(Tensor(a!)[] scene, float[] scene_scalars, int[] plane_layout, Tensor records, Tensor(b!) poses, "
      "Tensor frames, " SPS_RENDER_OPTIONS_SCHEMA
      ", int pixel_stream, int num_pixels, int iterations, int fixed_frame, Tensor(c!)[] embeddings, "
      "Tensor(d!)[] texels, Tensor(e!)[] geometry_params, Tensor(f!)[] color_params, Tensor(g!)[] pose_moments, "
      "float[] rates, int first_step, int first_stamp, Tensor(h!) losses, int precision=0, int graph=0) -> ()");
}
#endif

SPS_LIBRARY_IMPL(m) {
  m.impl("optimize_map_", TORCH_BOX(&optimize_map_));
}

}  // namespace spslam::bindings
