#include "spslam/interpolation.h"

#include <pybind11/stl.h>

#include "arrays.h"

namespace spslam::numpy {
namespace {

std::vector<std::int64_t> scatter_workspace(std::int64_t table_size) {
  return std::vector<std::int64_t>(scatter_workspace_words<Cpu>(table_size));
}

template <class T>
struct Trilinear {
  Trilinear(const char* name, const py::object& table, const py::object& corner_ids, const py::object& local_coords)
      : embeddings({name, "embeddings"}, table, {"V", "C"}),
        ids({name, "corner_ids"}, corner_ids, {"N", 8}),
        local({name, "local_coords"}, local_coords, {ids.size(0), 3}) {}
  Input<T> embeddings;
  Input<std::int32_t> ids;
  Input<T> local;
};

py::object trilinear(const py::object& embeddings, const py::object& corner_ids, const py::object& local_coords) {
  const char* name = "trilinear_interpolate";
  return dispatch_floating({name, "embeddings"}, embeddings, [&](auto zero) -> py::object {
    using T = decltype(zero);
    const Trilinear<T> in(name, embeddings, corner_ids, local_coords);
    auto out = empty<T>({in.ids.size(0), in.embeddings.size(1)});
    T* values = out.mutable_data();
    without_gil([&] {
      trilinear_interpolate(kCpu, in.embeddings.data(), in.embeddings.size(0), in.embeddings.size(1), in.ids.data(),
                            in.local.data(), in.ids.size(0), values);
    });
    return out;
  });
}

py::object trilinear_backward(const py::object& grad, const py::object& embeddings, const py::object& corner_ids,
                              const py::object& local_coords) {
  const char* name = "trilinear_interpolate_backward";
  return dispatch_floating({name, "embeddings"}, embeddings, [&](auto zero) -> py::object {
    using T = decltype(zero);
    const Trilinear<T> in(name, embeddings, corner_ids, local_coords);
    const std::int64_t points = in.ids.size(0), vertices = in.embeddings.size(0), channels = in.embeddings.size(1);
    const Input<T> g({name, "grad"}, grad, {points, channels});
    auto grad_embeddings = empty<T>({vertices, channels}), grad_local = empty<T>({points, 3});
    auto workspace = scatter_workspace(in.embeddings.numel());
    T *table = grad_embeddings.mutable_data(), *coords = grad_local.mutable_data();
    without_gil([&] {
      trilinear_interpolate_backward(kCpu, g.data(), in.embeddings.data(), vertices, channels, in.ids.data(),
                                     in.local.data(), points, table, coords, workspace.data());
    });
    return py::make_tuple(grad_embeddings, grad_local);
  });
}

template <class T>
struct Bilinear {
  Bilinear(const char* name, const py::object& table, const py::object& uv)
      : texels({name, "texels"}, table, {"H", "W", "C"}), positions({name, "uv"}, uv, {"N", 2}) {
    check((texels.size(0) > 0 && texels.size(1) > 0) || positions.size(0) == 0, {name, "texels"},
          "have at least one texel", 0);
  }
  Input<T> texels, positions;
};

py::object bilinear(const py::object& texels, const py::object& uv) {
  const char* name = "bilinear_interpolate";
  return dispatch_floating({name, "texels"}, texels, [&](auto zero) -> py::object {
    using T = decltype(zero);
    const Bilinear<T> in(name, texels, uv);
    auto out = empty<T>({in.positions.size(0), in.texels.size(2)});
    T* values = out.mutable_data();
    without_gil([&] {
      bilinear_interpolate(kCpu, in.texels.data(), in.texels.size(0), in.texels.size(1), in.texels.size(2),
                           in.positions.data(), in.positions.size(0), values);
    });
    return out;
  });
}

py::object bilinear_backward(const py::object& grad, const py::object& texels, const py::object& uv) {
  const char* name = "bilinear_interpolate_backward";
  return dispatch_floating({name, "texels"}, texels, [&](auto zero) -> py::object {
    using T = decltype(zero);
    const Bilinear<T> in(name, texels, uv);
    const std::int64_t height = in.texels.size(0), width = in.texels.size(1), channels = in.texels.size(2);
    const std::int64_t points = in.positions.size(0);
    const Input<T> g({name, "grad"}, grad, {points, channels});
    auto grad_texels = empty<T>({height, width, channels}), grad_uv = empty<T>({points, 2});
    auto workspace = scatter_workspace(in.texels.numel());
    T *table = grad_texels.mutable_data(), *coords = grad_uv.mutable_data();
    without_gil([&] {
      bilinear_interpolate_backward(kCpu, g.data(), in.texels.data(), height, width, channels, in.positions.data(),
                                    points, table, coords, workspace.data());
    });
    return py::make_tuple(grad_texels, grad_uv);
  });
}

template <class T>
struct TriPlanes {
  TriPlanes(const char* name, const py::object& table, const py::object& at, double cell_size,
            const std::vector<std::int64_t>& numbers)
      : texels({name, "texels"}, table, {"P", "C"}), points({name, "points"}, at, {"N", 3}) {
    check(cell_size > 0, {name, "cell_size"}, "be positive", cell_size);
    check(numbers.size() == 15, {name, "layout"}, "have 15 numbers", static_cast<std::int64_t>(numbers.size()));
    inverse_cell_size = static_cast<T>(1 / cell_size);
    for (int plane = 0; plane < 3; ++plane) layout.planes[plane] = checked_plane(name, numbers.data() + 5 * plane);
  }

  // Of five integers that may be any: their sums and products must not overflow before they are checked.
  PlaneLayout checked_plane(const char* name, const std::int64_t* p) const {
    constexpr std::int64_t kFarthest = std::int64_t{1} << 30;
    const std::int64_t offset = p[0], size_u = p[3], size_v = p[4], rows = texels.size(0);
    const auto near = [](std::int64_t number) { return number >= -kFarthest && number <= kFarthest; };
    check(near(p[1]) && near(p[2]) && near(size_u) && near(size_v), {name, "layout"},
          "have origins and sizes within 2^30", numbers_of(p));
    const bool fits = size_u >= 0 && size_v >= 0 && offset >= 0 && offset <= rows && size_u * size_v <= rows - offset;
    check(fits, {name, "layout"}, "lie within the " + std::to_string(rows) + " texels", numbers_of(p));
    return {offset, static_cast<std::int32_t>(p[1]), static_cast<std::int32_t>(p[2]), static_cast<std::int32_t>(size_u),
            static_cast<std::int32_t>(size_v)};
  }

  static std::string numbers_of(const std::int64_t* p) {
    std::string text = "[";
    for (int i = 0; i < 5; ++i) text += (i ? ", " : "") + std::to_string(p[i]);
    return text + "]";
  }

  Input<T> texels, points;
  T inverse_cell_size;
  TriPlaneLayout layout;
};

py::object tri_plane(const py::object& texels, const py::object& points, double cell_size,
                     const std::vector<std::int64_t>& layout) {
  const char* name = "tri_plane_interpolate";
  return dispatch_floating({name, "texels"}, texels, [&](auto zero) -> py::object {
    using T = decltype(zero);
    const TriPlanes<T> in(name, texels, points, cell_size, layout);
    auto out = empty<T>({in.points.size(0), in.texels.size(1)});
    T* values = out.mutable_data();
    without_gil([&] {
      tri_plane_interpolate(kCpu, in.texels.data(), in.texels.size(0), in.texels.size(1), in.points.data(),
                            in.points.size(0), in.inverse_cell_size, in.layout, values);
    });
    return out;
  });
}

py::object tri_plane_backward(const py::object& grad, const py::object& texels, const py::object& points,
                              double cell_size, const std::vector<std::int64_t>& layout) {
  const char* name = "tri_plane_interpolate_backward";
  return dispatch_floating({name, "texels"}, texels, [&](auto zero) -> py::object {
    using T = decltype(zero);
    const TriPlanes<T> in(name, texels, points, cell_size, layout);
    const std::int64_t rows = in.texels.size(0), channels = in.texels.size(1), count = in.points.size(0);
    const Input<T> g({name, "grad"}, grad, {count, channels});
    auto grad_texels = empty<T>({rows, channels}), grad_points = empty<T>({count, 3});
    auto workspace = scatter_workspace(in.texels.numel());
    T *table = grad_texels.mutable_data(), *coords = grad_points.mutable_data();
    without_gil([&] {
      tri_plane_interpolate_backward(kCpu, g.data(), in.texels.data(), rows, channels, in.points.data(), count,
                                     in.inverse_cell_size, in.layout, table, coords, workspace.data());
    });
    return py::make_tuple(grad_texels, grad_points);
  });
}

}  // namespace

void define_interpolation(py::module_& m) {
  m.def("trilinear_interpolate", &trilinear, py::arg("embeddings"), py::arg("corner_ids"), py::arg("local_coords"),
        "Features [N, C] at local_coords [N, 3] in the cells whose corners are rows corner_ids int32 [N, 8] of "
        "embeddings [V, C]; 0 where an id is outside [0, V).");
  m.def("trilinear_interpolate_backward", &trilinear_backward, py::arg("grad"), py::arg("embeddings"),
        py::arg("corner_ids"), py::arg("local_coords"), "Gradients of embeddings and local_coords from grad [N, C].");
  m.def("bilinear_interpolate", &bilinear, py::arg("texels"), py::arg("uv"),
        "Values [N, C] of an image [H, W, C] at uv [N, 2] in texels, u along W, clamped to the border.");
  m.def("bilinear_interpolate_backward", &bilinear_backward, py::arg("grad"), py::arg("texels"), py::arg("uv"),
        "Gradients of texels and uv from grad [N, C].");
  m.def(
      "tri_plane_interpolate", &tri_plane, py::arg("texels"), py::arg("points"), py::arg("cell_size"),
      py::arg("layout"),
      "Features [N, C] at points [N, 3] (m), summed over the xy, xz and yz planes; layout is five integers per plane: "
      "first row of texels [P, C], origin u, origin v, size u, size v.");
  m.def("tri_plane_interpolate_backward", &tri_plane_backward, py::arg("grad"), py::arg("texels"), py::arg("points"),
        py::arg("cell_size"), py::arg("layout"), "Gradients of texels and points from grad [N, C].");
}

}  // namespace spslam::numpy
