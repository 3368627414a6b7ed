#include "spslam/interpolation.h"

#include "bindings/plane_layout.h"

namespace spslam::bindings {
namespace {

using Sizes = std::vector<std::int64_t>;

// Gradient tensors that are not wanted come back empty.
struct Gradients {
  Tensor table, coords, workspace;

  Gradients(const Tensor& table_input, const Tensor& coords_input, bool need_table, bool need_coords)
      : table(empty(table_input, need_table ? sizes(table_input) : Sizes{0}, table_input.scalar_type())),
        coords(empty(coords_input, need_coords ? sizes(coords_input) : Sizes{0}, coords_input.scalar_type())),
        workspace(empty(table_input, {need_table ? scatter_workspace_words<Context>(table_input.numel()) : 0},
                        ScalarType::Long)) {}

  static Sizes sizes(const Tensor& tensor) { return {tensor.sizes().begin(), tensor.sizes().end()}; }
};

template <class T>
T* data_or_null(const Tensor& tensor, bool wanted) {
  return wanted ? mutable_data<T>(tensor) : nullptr;
}

void check_trilinear(const Tensor& embeddings, const Tensor& corner_ids, const Tensor& local_coords) {
  SPS_CHECK(embeddings.dim() == 2 && corner_ids.dim() == 2 && corner_ids.size(1) == 8 && local_coords.dim() == 2 &&
                local_coords.size(1) == 3 && local_coords.size(0) == corner_ids.size(0),
            "trilinear_interpolate: shapes must be [V, C], [N, 8], [N, 3]");
}

Tensor trilinear_interpolate(Tensor embeddings, Tensor corner_ids, Tensor local_coords) {
  check_trilinear(embeddings, corner_ids, local_coords);
  DeviceScope scope(embeddings);
  embeddings = as_contiguous(embeddings);
  corner_ids = as_contiguous(corner_ids);
  local_coords = as_contiguous(local_coords);
  const std::int64_t points = corner_ids.size(0), channels = embeddings.size(1);
  Tensor out = empty(embeddings, {points, channels}, embeddings.scalar_type());
  dispatch_floating("trilinear_interpolate", embeddings, [&](auto zero) {
    using T = decltype(zero);
    spslam::trilinear_interpolate(scope.context, data<T>(embeddings), embeddings.size(0), channels,
                                  data<std::int32_t>(corner_ids), data<T>(local_coords), points, mutable_data<T>(out));
  });
  return out;
}

std::tuple<Tensor, Tensor> trilinear_interpolate_backward(Tensor grad, Tensor embeddings, Tensor corner_ids,
                                                          Tensor local_coords, bool need_embeddings,
                                                          bool need_local_coords) {
  check_trilinear(embeddings, corner_ids, local_coords);
  DeviceScope scope(embeddings);
  grad = as_contiguous(grad);
  embeddings = as_contiguous(embeddings);
  corner_ids = as_contiguous(corner_ids);
  local_coords = as_contiguous(local_coords);
  const std::int64_t points = corner_ids.size(0), channels = embeddings.size(1);
  SPS_CHECK(has_shape(grad, {points, channels}), "trilinear_interpolate_backward: grad must have shape [N, C]");
  Gradients out(embeddings, local_coords, need_embeddings, need_local_coords);
  dispatch_floating("trilinear_interpolate_backward", embeddings, [&](auto zero) {
    using T = decltype(zero);
    spslam::trilinear_interpolate_backward(
        scope.context, data<T>(grad), data<T>(embeddings), embeddings.size(0), channels, data<std::int32_t>(corner_ids),
        data<T>(local_coords), points, data_or_null<T>(out.table, need_embeddings),
        data_or_null<T>(out.coords, need_local_coords), mutable_data<std::int64_t>(out.workspace));
  });
  return {out.table, out.coords};
}

void check_bilinear(const Tensor& texels, const Tensor& uv) {
  SPS_CHECK(texels.dim() == 3 && uv.dim() == 2 && uv.size(1) == 2,
            "bilinear_interpolate: shapes must be [H, W, C], [N, 2]");
  SPS_CHECK((texels.size(0) > 0 && texels.size(1) > 0) || uv.size(0) == 0,
            "bilinear_interpolate: texels must not be empty");
}

Tensor bilinear_interpolate(Tensor texels, Tensor uv) {
  check_bilinear(texels, uv);
  DeviceScope scope(texels);
  texels = as_contiguous(texels);
  uv = as_contiguous(uv);
  const std::int64_t points = uv.size(0), channels = texels.size(2);
  Tensor out = empty(texels, {points, channels}, texels.scalar_type());
  dispatch_floating("bilinear_interpolate", texels, [&](auto zero) {
    using T = decltype(zero);
    spslam::bilinear_interpolate(scope.context, data<T>(texels), texels.size(0), texels.size(1), channels, data<T>(uv),
                                 points, mutable_data<T>(out));
  });
  return out;
}

std::tuple<Tensor, Tensor> bilinear_interpolate_backward(Tensor grad, Tensor texels, Tensor uv, bool need_texels,
                                                         bool need_uv) {
  check_bilinear(texels, uv);
  DeviceScope scope(texels);
  grad = as_contiguous(grad);
  texels = as_contiguous(texels);
  uv = as_contiguous(uv);
  const std::int64_t points = uv.size(0), channels = texels.size(2);
  SPS_CHECK(has_shape(grad, {points, channels}), "bilinear_interpolate_backward: grad must have shape [N, C]");
  Gradients out(texels, uv, need_texels, need_uv);
  dispatch_floating("bilinear_interpolate_backward", texels, [&](auto zero) {
    using T = decltype(zero);
    spslam::bilinear_interpolate_backward(scope.context, data<T>(grad), data<T>(texels), texels.size(0), texels.size(1),
                                          channels, data<T>(uv), points, data_or_null<T>(out.table, need_texels),
                                          data_or_null<T>(out.coords, need_uv),
                                          mutable_data<std::int64_t>(out.workspace));
  });
  return {out.table, out.coords};
}

TriPlaneLayout checked_layout(const Tensor& texels, const Tensor& points, const Sizes& layout) {
  SPS_CHECK(texels.dim() == 2 && points.dim() == 2 && points.size(1) == 3,
            "tri_plane_interpolate: shapes must be [P, C], [N, 3]");
  return load_plane_layout("tri_plane_interpolate", layout, texels.size(0));
}

Tensor tri_plane_interpolate(Tensor texels, Tensor points, double cell_size, Sizes layout) {
  const TriPlaneLayout planes = checked_layout(texels, points, layout);
  DeviceScope scope(texels);
  texels = as_contiguous(texels);
  points = as_contiguous(points);
  Tensor out = empty(texels, {points.size(0), texels.size(1)}, texels.scalar_type());
  dispatch_floating("tri_plane_interpolate", texels, [&](auto zero) {
    using T = decltype(zero);
    spslam::tri_plane_interpolate(scope.context, data<T>(texels), texels.size(0), texels.size(1), data<T>(points),
                                  points.size(0), static_cast<T>(1 / cell_size), planes, mutable_data<T>(out));
  });
  return out;
}

std::tuple<Tensor, Tensor> tri_plane_interpolate_backward(Tensor grad, Tensor texels, Tensor points, double cell_size,
                                                          Sizes layout, bool need_texels, bool need_points) {
  const TriPlaneLayout planes = checked_layout(texels, points, layout);
  DeviceScope scope(texels);
  grad = as_contiguous(grad);
  texels = as_contiguous(texels);
  points = as_contiguous(points);
  SPS_CHECK(has_shape(grad, {points.size(0), texels.size(1)}),
            "tri_plane_interpolate_backward: grad must have shape [N, C]");
  Gradients out(texels, points, need_texels, need_points);
  dispatch_floating("tri_plane_interpolate_backward", texels, [&](auto zero) {
    using T = decltype(zero);
    spslam::tri_plane_interpolate_backward(
        scope.context, data<T>(grad), data<T>(texels), texels.size(0), texels.size(1), data<T>(points), points.size(0),
        static_cast<T>(1 / cell_size), planes, data_or_null<T>(out.table, need_texels),
        data_or_null<T>(out.coords, need_points), mutable_data<std::int64_t>(out.workspace));
  });
  return {out.table, out.coords};
}

}  // namespace

#ifndef SPS_CUDA
STABLE_TORCH_LIBRARY_FRAGMENT(spslam, m) {
  m.def("trilinear_interpolate(Tensor embeddings, Tensor corner_ids, Tensor local_coords) -> Tensor");
  m.def(
      "trilinear_interpolate_backward(Tensor grad, Tensor embeddings, Tensor corner_ids, Tensor local_coords, "
      "bool need_embeddings=True, bool need_local_coords=True) -> (Tensor, Tensor)");
  m.def("bilinear_interpolate(Tensor texels, Tensor uv) -> Tensor");
  m.def(
      "bilinear_interpolate_backward(Tensor grad, Tensor texels, Tensor uv, bool need_texels=True, bool need_uv=True) "
      "-> (Tensor, Tensor)");
  m.def("tri_plane_interpolate(Tensor texels, Tensor points, float cell_size, int[] layout) -> Tensor");
  m.def(
      "tri_plane_interpolate_backward(Tensor grad, Tensor texels, Tensor points, float cell_size, int[] layout, "
      "bool need_texels=True, bool need_points=True) -> (Tensor, Tensor)");
}
#endif

SPS_LIBRARY_IMPL(m) {
  m.impl("trilinear_interpolate", TORCH_BOX(&trilinear_interpolate));
  m.impl("trilinear_interpolate_backward", TORCH_BOX(&trilinear_interpolate_backward));
  m.impl("bilinear_interpolate", TORCH_BOX(&bilinear_interpolate));
  m.impl("bilinear_interpolate_backward", TORCH_BOX(&bilinear_interpolate_backward));
  m.impl("tri_plane_interpolate", TORCH_BOX(&tri_plane_interpolate));
  m.impl("tri_plane_interpolate_backward", TORCH_BOX(&tri_plane_interpolate_backward));
}

}  // namespace spslam::bindings
