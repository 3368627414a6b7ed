#include "spslam/scene_query.h"

#include "bindings/scene.h"

namespace spslam::bindings {
namespace {

std::tuple<Tensor, Tensor, Tensor> query_sdf(std::vector<Tensor> tensors, std::vector<double> scalars,
                                             std::vector<std::int64_t> layout, Tensor points, bool with_gradient) {
  SPS_CHECK(points.dim() == 2 && points.size(1) == 3, "query_sdf: points must have shape [N, 3]");
  DeviceScope scope(points);
  const SceneArgument scene(tensors, scalars, layout);
  points = as_contiguous(points);
  const std::int64_t n = points.size(0);
  Tensor sdf = empty(points, {n}, ScalarType::Float);
  Tensor valid = empty(points, {n}, ScalarType::Bool);
  Tensor gradient = empty(points, {with_gradient ? n : 0, 3}, ScalarType::Float);
  spslam::query_sdf(scope.context, scene.view, data<float>(points), n, mutable_data<float>(sdf),
                    mutable_data<bool>(valid), with_gradient ? mutable_data<float>(gradient) : nullptr);
  return {sdf, valid, gradient};
}

Tensor query_color(std::vector<Tensor> tensors, std::vector<double> scalars, std::vector<std::int64_t> layout,
                   Tensor points) {
  SPS_CHECK(points.dim() == 2 && points.size(1) == 3, "query_color: points must have shape [N, 3]");
  DeviceScope scope(points);
  const SceneArgument scene(tensors, scalars, layout);
  points = as_contiguous(points);
  Tensor color = empty(points, {points.size(0), 3}, ScalarType::Float);
  spslam::query_color(scope.context, scene.view, data<float>(points), points.size(0), mutable_data<float>(color));
  return color;
}

}  // namespace

#ifndef SPS_CUDA
STABLE_TORCH_LIBRARY_FRAGMENT(spslam, m) {
  m.def("query_sdf(" SPS_SCENE_SCHEMA ", Tensor points, bool with_gradient) -> (Tensor, Tensor, Tensor)");
  m.def("query_color(" SPS_SCENE_SCHEMA ", Tensor points) -> Tensor");
}
#endif

SPS_LIBRARY_IMPL(m) {
  m.impl("query_sdf", TORCH_BOX(&query_sdf));
  m.impl("query_color", TORCH_BOX(&query_color));
}

}  // namespace spslam::bindings
