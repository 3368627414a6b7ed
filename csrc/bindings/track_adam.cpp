#include "spslam/track_adam.h"

#include "bindings/launch_graph.h"
#include "bindings/render_options.h"
#include "bindings/scene.h"

namespace spslam::bindings {
namespace {

constexpr char kName[] = "track_adam";

// Places in the op's lists of numbers; spslam/ops/track_adam.py fills them.
enum class Rate { kRotation, kTranslation, kCount };
enum class Integer { kPixelStream, kNumPixels, kIterations, kGraph, kCount };

std::tuple<Tensor, Tensor> track_adam(std::vector<Tensor> scene_tensors, std::vector<double> scene_scalars,
                                      std::vector<std::int64_t> plane_layout, Tensor records, Tensor pose,
                                      std::vector<double> render_scalars, std::vector<std::int64_t> render_integers,
                                      std::vector<double> rate_list, std::vector<std::int64_t> integer_list) {
  const Scalars<Rate> rates(kName, "rates", rate_list);
  const Integers<Integer> integers(kName, "integers", integer_list);
  SPS_CHECK(records.dim() == 2 && records.size(0) >= 1 && records.size(1) == 3, kName,
            ": records must have shape [P, 3] with P >= 1");
  SPS_CHECK(pose.numel() == kPoseSize, kName, ": pose must have 7 elements");
  check_count(kName, "num_pixels", integers[Integer::kNumPixels]);
  check_count(kName, "iterations", integers[Integer::kIterations]);
  DeviceScope scope(pose);
  const SceneArgument scene(scene_tensors, scene_scalars, plane_layout);
  const RenderArgument render(kName, render_scalars, render_integers);
  records = as_contiguous(records);
  pose = as_contiguous(pose);
  PoseTracking call{};
  call.scene = scene.view;
  call.rays.records = data<std::int32_t>(records);
  call.rays.records_per_row = records.size(0);
  call.rays.draw = render.pixel_key(integers[Integer::kPixelStream]);
  call.rays.num_rays = integers[Integer::kNumPixels];
  call.rays.num_slots = 1;
  call.intrinsics = render.intrinsics;
  call.options = render.options;
  call.iterations = integers[Integer::kIterations];
  call.rotation_rate = rates[Rate::kRotation];
  call.translation_rate = rates[Rate::kTranslation];
  Tensor best = empty(pose, {kPoseSize}, ScalarType::Float);
  Tensor losses = empty(pose, {call.iterations, kLossTerms}, ScalarType::Float);
  call.start = data<float>(pose);
  call.best = mutable_data<float>(best);
  call.losses = mutable_data<float>(losses);
  Tensor workspace = empty(pose, {track_adam_workspace_size(scope.context, call)}, ScalarType::Byte);
  spslam::track_adam(scope.context, call, workspace.mutable_data_ptr(), find_launch_graph(integers[Integer::kGraph]));
  return {best, losses};
}

}  // namespace

#ifndef SPS_CUDA
STABLE_TORCH_LIBRARY_FRAGMENT(spslam, m) {
  m.def("track_adam(" SPS_SCENE_SCHEMA ", Tensor records, Tensor pose, " SPS_RENDER_SCHEMA
        ", float[] rates, int[] integers) -> (Tensor, Tensor)");
}
#endif

SPS_LIBRARY_IMPL(m) {
  m.impl("track_adam", TORCH_BOX(&track_adam));
}

}  // namespace spslam::bindings
