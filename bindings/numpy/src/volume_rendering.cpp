#include "spslam/volume_rendering.h"

#include "arrays.h"

namespace spslam::numpy {
namespace {

template <class T>
struct Samples {
  Samples(const char* name, const py::object& sdf_in, const py::object& t_in, const py::object& valid_in,
          double truncation)
      : sdf({name, "sdf"}, sdf_in, {"R", "S"}),
        t({name, "t"}, t_in, {sdf.size(0), sdf.size(1)}),
        valid({name, "valid"}, valid_in, {sdf.size(0), sdf.size(1)}) {
    check(truncation > 0, {name, "truncation"}, "be positive", truncation);
  }
  std::int64_t rays() const { return sdf.size(0); }
  std::int64_t count() const { return sdf.size(1); }
  SampleTable<T> table() const { return {sdf.data(), t.data(), valid.data(), rays(), count()}; }
  Input<T> sdf, t;
  Input<bool> valid;
};

py::object render(const py::object& sdf, const py::object& color, const py::object& t, const py::object& valid,
                  double truncation) {
  const char* name = "volume_render";
  return dispatch_floating({name, "sdf"}, sdf, [&](auto zero) -> py::object {
    using T = decltype(zero);
    const Samples<T> in(name, sdf, t, valid, truncation);
    const Input<T> colors({name, "color"}, color, {in.rays(), in.count(), 3});
    auto out_color = empty<T>({in.rays(), 3}), depth = empty<T>({in.rays()}),
         weights = empty<T>({in.rays(), in.count()});
    T *c = out_color.mutable_data(), *d = depth.mutable_data(), *w = weights.mutable_data();
    without_gil([&] { volume_render(kCpu, in.table(), colors.data(), static_cast<T>(truncation), c, d, w); });
    return py::make_tuple(out_color, depth, weights);
  });
}

py::object render_backward(const py::object& grad_color, const py::object& grad_depth, const py::object& grad_weights,
                           const py::object& sdf, const py::object& color, const py::object& t, const py::object& valid,
                           const py::object& weights, double truncation) {
  const char* name = "volume_render_backward";
  return dispatch_floating({name, "sdf"}, sdf, [&](auto zero) -> py::object {
    using T = decltype(zero);
    const Samples<T> in(name, sdf, t, valid, truncation);
    const Shape samples{in.rays(), in.count()};
    const Input<T> colors({name, "color"}, color, {in.rays(), in.count(), 3});
    const Input<T> w({name, "weights"}, weights, samples);
    const Input<T> gc({name, "grad_color"}, grad_color, {in.rays(), 3});
    const Input<T> gd({name, "grad_depth"}, grad_depth, {in.rays()});
    const Input<T> gw({name, "grad_weights"}, grad_weights, samples);
    auto out_sdf = empty<T>({in.rays(), in.count()}), out_color = empty<T>({in.rays(), in.count(), 3}),
         out_t = empty<T>({in.rays(), in.count()});
    T *s = out_sdf.mutable_data(), *c = out_color.mutable_data(), *d = out_t.mutable_data();
    without_gil([&] {
      volume_render_backward(kCpu, in.table(), colors.data(), w.data(), static_cast<T>(truncation), gc.data(),
                             gd.data(), gw.data(), s, c, d);
    });
    return py::make_tuple(out_sdf, out_color, out_t);
  });
}

py::object losses(const py::object& color, const py::object& depth, const py::object& sdf, const py::object& t,
                  const py::object& valid, const py::object& rendered, const py::object& target_color,
                  const py::object& target_depth, const py::object& cosine, double truncation, bool cosine_targets) {
  const char* name = "rendering_losses";
  return dispatch_floating({name, "sdf"}, sdf, [&](auto zero) -> py::object {
    using T = decltype(zero);
    const Samples<T> in(name, sdf, t, valid, truncation);
    const std::int64_t rays = in.rays();
    const Input<T> c({name, "color"}, color, {rays, 3}), d({name, "depth"}, depth, {rays});
    const Input<bool> r({name, "rendered"}, rendered, {rays});
    const Input<T> tc({name, "target_color"}, target_color, {rays, 3}),
        td({name, "target_depth"}, target_depth, {rays});
    const Input<T> n({name, "cosine"}, cosine, {rays});
    const LossInputs<T> inputs{
        c.data(), d.data(), r.data(), tc.data(), td.data(), n.data(), static_cast<T>(truncation), cosine_targets};
    std::vector<T> workspace(rendering_losses_workspace(rays));
    auto out = empty<T>({4});
    T* terms = out.mutable_data();
    without_gil([&] { rendering_losses(kCpu, in.table(), inputs, terms, workspace.data()); });
    return out;
  });
}

}  // namespace

void define_volume_rendering(py::module_& m) {
  m.def("volume_render", &render, py::arg("sdf"), py::arg("color"), py::arg("t"), py::arg("valid"),
        py::arg("truncation"),
        "color [R, 3], depth [R] (m) and weights [R, S] of rays with samples sdf [R, S] (over the truncation), color "
        "[R, S, 3], t [R, S] (m) and valid bool [R, S].");
  m.def("volume_render_backward", &render_backward, py::arg("grad_color"), py::arg("grad_depth"),
        py::arg("grad_weights"), py::arg("sdf"), py::arg("color"), py::arg("t"), py::arg("valid"), py::arg("weights"),
        py::arg("truncation"), "Gradients of sdf, color and t; `weights` are those that volume_render gave.");
  m.def("rendering_losses", &losses, py::arg("color"), py::arg("depth"), py::arg("sdf"), py::arg("t"), py::arg("valid"),
        py::arg("rendered"), py::arg("target_color"), py::arg("target_depth"), py::arg("cosine"), py::arg("truncation"),
        py::arg("cosine_targets"), "The terms [4] rgb, depth, free space and SDF, each averaged over all rays.");
}

}  // namespace spslam::numpy
