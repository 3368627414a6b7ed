#include "spslam/projective_icp.h"

#include "bindings/scene.h"

namespace spslam::bindings {
namespace {

std::tuple<Tensor, Tensor, Tensor> projective_icp(Tensor points, Tensor vertices, Tensor normals, Tensor pose,
                                                  std::vector<double> intrinsics, std::int64_t iterations,
                                                  double max_distance, double kernel_start, double kernel_end,
                                                  double damping) {
  SPS_CHECK(points.dim() == 3 && points.size(2) == 3, "projective_icp: points must have shape [B, N, 3]");
  SPS_CHECK(has_shape(vertices, {-1, -1, 3}) && same_shape(normals, vertices),
            "projective_icp: vertices and normals must have shape [H, W, 3]");
  const std::int64_t count = points.size(0);
  SPS_CHECK(has_shape(pose, {count, kPoseSize}), "projective_icp: pose must have shape [B, 7]");
  check_count("projective_icp", "iterations", iterations);
  DeviceScope scope(points);
  points = as_contiguous(points);
  vertices = as_contiguous(vertices);
  normals = as_contiguous(normals);
  Tensor result = torch::stable::clone(as_contiguous(pose));
  Tensor stats = empty(pose, {count, iterations, kTrackingStatSize}, ScalarType::Float);
  Tensor hessian = empty(pose, {count, 6, 6}, ScalarType::Float);
  const PointClouds sources{data<float>(points), count, points.size(1)};
  Tensor workspace = empty(points, {projective_icp_workspace_size(scope.context, sources)}, ScalarType::Byte);
  const SurfaceMaps target{data<float>(vertices), data<float>(normals), vertices.size(0), vertices.size(1),
                           load_intrinsics("projective_icp", intrinsics)};
  const IcpOptions options{iterations, static_cast<float>(max_distance), static_cast<float>(kernel_start),
                           static_cast<float>(kernel_end), damping};
  spslam::projective_icp(scope.context, sources, target, options, workspace.mutable_data_ptr(),
                         mutable_data<float>(result), mutable_data<float>(stats), mutable_data<float>(hessian));
  return {result, stats, hessian};
}

}  // namespace

#ifndef SPS_CUDA
STABLE_TORCH_LIBRARY_FRAGMENT(spslam, m) {
  m.def(
      "projective_icp(Tensor points, Tensor vertices, Tensor normals, Tensor pose, float[] intrinsics, "
      "int iterations, float max_distance, float kernel_start, float kernel_end, float damping) "
      "-> (Tensor, Tensor, Tensor)");
}
#endif

SPS_LIBRARY_IMPL(m) {
  m.impl("projective_icp", TORCH_BOX(&projective_icp));
}

}  // namespace spslam::bindings
