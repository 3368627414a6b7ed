#include "spslam/seen_points.h"

#include "bindings/common.h"

namespace spslam::bindings {
namespace {

std::tuple<Tensor, Tensor> see_points(Tensor points, Tensor normals, Tensor spheres, Tensor depth, Tensor color,
                                      Tensor pose, std::vector<double> intrinsics, std::vector<double> noise) {
  constexpr char kName[] = "see_points";
  constexpr std::int64_t kMostSide = 1 << 14;
  SPS_CHECK(has_shape(points, {-1, 3}) && same_shape(normals, points), kName,
            ": points and normals must have shape [N, 3]");
  const std::int64_t count = points.size(0);
  SPS_CHECK(has_shape(spheres, {(count + kSeenRun - 1) / kSeenRun, 4}), kName, ": spheres must have shape [N / ",
            kSeenRun, ", 4], rounded up");
  SPS_CHECK(depth.dim() == 2 && has_shape(color, {depth.size(0), depth.size(1), 3}), kName,
            ": depth and color must have shapes [H, W] and [H, W, 3]");
  SPS_CHECK(depth.size(0) <= kMostSide && depth.size(1) <= kMostSide, kName, ": images must have at most ", kMostSide,
            " pixels per side");
  SPS_CHECK(has_shape(pose, {kPoseSize}), kName, ": pose must have shape [7]");
  SPS_CHECK(noise.size() == 2 && noise[0] >= 0.0 && noise[1] >= 0.0, kName,
            ": noise must be two numbers of at least 0");
  DeviceScope scope(points);
  points = as_contiguous(points);
  normals = as_contiguous(normals);
  spheres = as_contiguous(spheres);
  depth = as_contiguous(depth);
  color = as_contiguous(color);
  pose = as_contiguous(pose);
  const SeenSurface surface{data<float>(points), data<float>(normals), data<float>(spheres), count};
  const SeenFrame frame{data<float>(depth),
                        data<std::uint8_t>(color),
                        data<float>(pose),
                        static_cast<std::int32_t>(depth.size(1)),
                        static_cast<std::int32_t>(depth.size(0)),
                        load_intrinsics(kName, intrinsics),
                        {static_cast<float>(noise[0]), static_cast<float>(noise[1])}};
  const Tensor colors = empty(points, {count, 3}, ScalarType::Byte),
               weights = empty(points, {count}, ScalarType::Float);
  const Tensor workspace = empty(points, {see_points_workspace_bytes(frame)}, ScalarType::Byte);
  spslam::see_points(scope.context, surface, frame, mutable_data<std::uint8_t>(colors), mutable_data<float>(weights),
                     mutable_data<std::uint8_t>(workspace));
  return {colors, weights};
}

void check_seen(const char* name, const Tensor& colors, const Tensor& weights) {
  SPS_CHECK(has_shape(colors, {-1, 3}) && has_shape(weights, {colors.size(0)}), name,
            ": colors and weights must have shapes [N, 3] and [N]");
}

void add_seen_colors(Tensor sums, Tensor colors, Tensor weights) {
  constexpr char kName[] = "add_seen_colors_";
  check_seen(kName, colors, weights);
  SPS_CHECK(has_shape(sums, {colors.size(0), 4}), kName, ": sums must have shape [N, 4]");
  DeviceScope scope(sums);
  colors = as_contiguous(colors);
  weights = as_contiguous(weights);
  spslam::add_seen_colors(scope.context, data<std::uint8_t>(colors), data<float>(weights), colors.size(0),
                          mutable_data<float>(sums));
}

void add_color_detail(Tensor sums, Tensor colors, Tensor weights, Tensor ends) {
  constexpr char kName[] = "add_color_detail_";
  check_seen(kName, colors, weights);
  SPS_CHECK(has_shape(sums, {-1, 5}) && has_shape(ends, {sums.size(0), 2}) && sums.size(0) <= colors.size(0), kName,
            ": sums and ends must have shapes [M, 5] and [M, 2], and M be at most N");
  DeviceScope scope(sums);
  colors = as_contiguous(colors);
  weights = as_contiguous(weights);
  ends = as_contiguous(ends);
  const SeenEdges edges{data<std::int64_t>(ends), sums.size(0), colors.size(0) - sums.size(0)};
  spslam::add_color_detail(scope.context, data<std::uint8_t>(colors), data<float>(weights), edges,
                           mutable_data<float>(sums));
}

}  // namespace

#ifndef SPS_CUDA
STABLE_TORCH_LIBRARY_FRAGMENT(spslam, m) {
  m.def(
      "see_points(Tensor points, Tensor normals, Tensor spheres, Tensor depth, Tensor color, Tensor pose, "
      "float[] intrinsics, float[] noise) -> (Tensor, Tensor)");
  m.def("add_seen_colors_(Tensor(a!) sums, Tensor colors, Tensor weights) -> ()");
  m.def("add_color_detail_(Tensor(a!) sums, Tensor colors, Tensor weights, Tensor ends) -> ()");
}
#endif

SPS_LIBRARY_IMPL(m) {
  m.impl("see_points", TORCH_BOX(&see_points));
  m.impl("add_seen_colors_", TORCH_BOX(&add_seen_colors));
  m.impl("add_color_detail_", TORCH_BOX(&add_color_detail));
}

}  // namespace spslam::bindings
