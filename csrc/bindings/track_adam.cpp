#include "spslam/track_adam.h"

#include "bindings/launch_graph.h"
#include "bindings/render_options.h"
#include "bindings/scene.h"

namespace spslam::bindings {
namespace {

constexpr char kName[] = "track_adam";

std::tuple<Tensor, Tensor> track_adam(std::vector<Tensor> scene_tensors, std::vector<double> scene_scalars,
                                      std::vector<std::int64_t> plane_layout, Tensor records, Tensor pose,
                                      SPS_RENDER_OPTIONS_PARAMETERS, std::int64_t pixel_stream, std::int64_t num_pixels,
                                      std::int64_t iterations, double rotation_rate, double translation_rate,
                                      std::int64_t precision, std::int64_t graph) {
  SPS_CHECK(records.dim() == 2 && records.size(0) >= 1 && records.size(1) == 3, kName,
            ": records must have shape [P, 3] with P >= 1");
  SPS_CHECK(pose.numel() == 7, kName, ": pose must have 7 elements");
  check_count(kName, "num_pixels", num_pixels);
  check_count(kName, "iterations", iterations);
  DeviceScope scope(pose);
  const SceneArgument scene(scene_tensors, scene_scalars, plane_layout);
  records = contiguous(records);
  pose = contiguous(pose);
  Tensor best = empty(pose, {7}, ScalarType::Float);
  Tensor losses = empty(pose, {iterations, kLossTerms}, ScalarType::Float);
  PoseTracking call{};
  call.scene = scene.view;
  call.rays.records = data<std::int32_t>(records);
  call.rays.records_per_row = records.size(0);
  call.rays.draw = philox_key(seed, pixel_stream, frame, iteration);
  call.rays.num_rays = num_pixels;
  call.rays.num_slots = 1;
  call.intrinsics = load_intrinsics(kName, intrinsics);
  call.options = load_options(kName, num_uniform, num_surface, near, far, truncation, cosine_targets, weights,
                              philox_key(seed, stream, frame, iteration), precision);
  call.iterations = iterations;
  call.rotation_rate = rotation_rate;
  call.translation_rate = translation_rate;
  call.start = data<float>(pose);
  call.best = mutable_data<float>(best);
  call.losses = mutable_data<float>(losses);
  Tensor workspace = empty(pose, {track_adam_workspace_size(scope.context, call)}, ScalarType::Byte);
  spslam::track_adam(scope.context, call, workspace.mutable_data_ptr(), find_launch_graph(graph));
  return {best, losses};
}

}  // namespace

#ifndef SPS_CUDA
STABLE_TORCH_LIBRARY_FRAGMENT(spslam, m) {
  m.def("track_adam(" SPS_SCENE_SCHEMA ", Tensor records, Tensor pose, " SPS_RENDER_OPTIONS_SCHEMA
        ", int pixel_stream, int num_pixels, int iterations, float rotation_rate, float translation_rate, "
        "int precision=0, int graph=0) -> (Tensor, Tensor)");
}
#endif

SPS_LIBRARY_IMPL(m) {
  m.impl("track_adam", TORCH_BOX(&track_adam));
}

}  // namespace spslam::bindings
