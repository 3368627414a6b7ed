#include "spslam/volume_rendering.h"

#include "bindings/common.h"

namespace spslam::bindings {
namespace {

// The samples of all rays, kept contiguous while a kernel reads them.
struct Samples {
  Tensor sdf, t, valid;

  Samples(const char* function, const Tensor& sdf_, const Tensor& t_, const Tensor& valid_)
      : sdf(as_contiguous(sdf_)), t(as_contiguous(t_)), valid(as_contiguous(valid_)) {
    SPS_CHECK(sdf.dim() == 2 && t.dim() == 2 && valid.dim() == 2 && t.size(0) == sdf.size(0) &&
                  t.size(1) == sdf.size(1) && valid.size(0) == sdf.size(0) && valid.size(1) == sdf.size(1),
              function, ": sdf, t and valid must have shape [R, S]");
  }

  std::int64_t rays() const { return sdf.size(0); }
  std::int64_t count() const { return sdf.size(1); }

  template <class T>
  SampleTable<T> table() const {
    return {data<T>(sdf), data<T>(t), data<bool>(valid), rays(), count()};
  }
};

void check_shape(const char* function, const char* argument, const Tensor& tensor,
                 std::initializer_list<std::int64_t> shape) {
  SPS_CHECK(has_shape(tensor, shape), function, ": ", argument, " must fit the shape of sdf");
}

// Channels of the color of a ray's samples: 3, or 0 where only depth and weights are wanted.
std::int64_t color_channels(const char* function, const Samples& samples, const Tensor& color) {
  const bool colored = !has_shape(color, {-1, -1, 0});
  check_shape(function, "color", color, {samples.rays(), samples.count(), colored ? 3 : 0});
  return colored ? 3 : 0;
}

std::tuple<Tensor, Tensor, Tensor> volume_render(Tensor sdf, Tensor color, Tensor t, Tensor valid, double truncation) {
  const Samples samples("volume_render", sdf, t, valid);
  const std::int64_t channels = color_channels("volume_render", samples, color);
  DeviceScope scope(sdf);
  color = as_contiguous(color);
  const ScalarType dtype = sdf.scalar_type();
  Tensor out_color = empty(sdf, {samples.rays(), channels}, dtype), out_depth = empty(sdf, {samples.rays()}, dtype);
  Tensor weights = empty(sdf, {samples.rays(), samples.count()}, dtype);
  dispatch_floating("volume_render", sdf, [&](auto zero) {
    using T = decltype(zero);
    spslam::volume_render(scope.context, samples.table<T>(), data<T>(color), static_cast<T>(truncation),
                          channels ? mutable_data<T>(out_color) : nullptr, mutable_data<T>(out_depth),
                          mutable_data<T>(weights));
  });
  return {out_color, out_depth, weights};
}

std::tuple<Tensor, Tensor, Tensor> volume_render_backward(Tensor grad_color, Tensor grad_depth,
                                                          std::optional<Tensor> grad_weights, Tensor sdf, Tensor color,
                                                          Tensor t, Tensor valid, Tensor weights, double truncation) {
  const char* name = "volume_render_backward";
  const Samples samples(name, sdf, t, valid);
  const std::int64_t channels = color_channels(name, samples, color);
  check_shape(name, "weights", weights, {samples.rays(), samples.count()});
  check_shape(name, "grad_color", grad_color, {samples.rays(), channels});
  check_shape(name, "grad_depth", grad_depth, {samples.rays()});
  if (grad_weights) check_shape(name, "grad_weights", *grad_weights, {samples.rays(), samples.count()});
  DeviceScope scope(sdf);
  color = as_contiguous(color);
  weights = as_contiguous(weights);
  grad_color = as_contiguous(grad_color);
  grad_depth = as_contiguous(grad_depth);
  if (grad_weights) grad_weights = as_contiguous(*grad_weights);
  const ScalarType dtype = sdf.scalar_type();
  const std::int64_t rays = samples.rays(), count = samples.count();
  Tensor sdf_out = empty(sdf, {rays, count}, dtype), color_out = empty(sdf, {rays, count, channels}, dtype);
  Tensor t_out = empty(sdf, {rays, count}, dtype);
  dispatch_floating(name, sdf, [&](auto zero) {
    using T = decltype(zero);
    spslam::volume_render_backward(scope.context, samples.table<T>(), data<T>(color), data<T>(weights),
                                   static_cast<T>(truncation), channels ? data<T>(grad_color) : nullptr,
                                   data<T>(grad_depth), grad_weights ? data<T>(*grad_weights) : nullptr,
                                   mutable_data<T>(sdf_out), mutable_data<T>(color_out), mutable_data<T>(t_out));
  });
  return {sdf_out, color_out, t_out};
}

// The per-ray inputs of the losses, kept contiguous while a kernel reads them.
struct Targets {
  Tensor color, depth, rendered, target_color, target_depth, cosine;
  double truncation;
  bool cosine_targets;

  void make_contiguous(const char* function, std::int64_t rays) {
    check_shape(function, "color", color, {rays, 3});
    check_shape(function, "target_color", target_color, {rays, 3});
    check_shape(function, "depth", depth, {rays});
    check_shape(function, "rendered", rendered, {rays});
    check_shape(function, "target_depth", target_depth, {rays});
    check_shape(function, "cosine", cosine, {rays});
    for (Tensor* tensor : {&color, &depth, &rendered, &target_color, &target_depth, &cosine}) {
      *tensor = as_contiguous(*tensor);
    }
  }

  template <class T>
  LossInputs<T> inputs() const {
    return {data<T>(color),        data<T>(depth),  data<bool>(rendered),       data<T>(target_color),
            data<T>(target_depth), data<T>(cosine), static_cast<T>(truncation), cosine_targets};
  }
};

Tensor rendering_losses(Tensor color, Tensor depth, Tensor sdf, Tensor t, Tensor valid, Tensor rendered,
                        Tensor target_color, Tensor target_depth, Tensor cosine, double truncation,
                        bool cosine_targets) {
  const Samples samples("rendering_losses", sdf, t, valid);
  DeviceScope scope(sdf);
  Targets targets{color, depth, rendered, target_color, target_depth, cosine, truncation, cosine_targets};
  targets.make_contiguous("rendering_losses", samples.rays());
  Tensor losses = empty(sdf, {4}, sdf.scalar_type());
  Tensor workspace = empty(sdf, {rendering_losses_workspace(samples.rays())}, sdf.scalar_type());
  dispatch_floating("rendering_losses", sdf, [&](auto zero) {
    using T = decltype(zero);
    spslam::rendering_losses(scope.context, samples.table<T>(), targets.inputs<T>(), mutable_data<T>(losses),
                             mutable_data<T>(workspace));
  });
  return losses;
}

std::tuple<Tensor, Tensor, Tensor, Tensor> rendering_losses_backward(Tensor grad, Tensor color, Tensor depth,
                                                                     Tensor sdf, Tensor t, Tensor valid,
                                                                     Tensor rendered, Tensor target_color,
                                                                     Tensor target_depth, Tensor cosine,
                                                                     double truncation, bool cosine_targets) {
  const char* name = "rendering_losses_backward";
  const Samples samples(name, sdf, t, valid);
  SPS_CHECK(has_shape(grad, {4}), name, ": grad must have shape [4]");
  DeviceScope scope(sdf);
  Targets targets{color, depth, rendered, target_color, target_depth, cosine, truncation, cosine_targets};
  targets.make_contiguous(name, samples.rays());
  grad = as_contiguous(grad);
  const ScalarType dtype = sdf.scalar_type();
  const std::int64_t rays = samples.rays(), count = samples.count();
  Tensor color_out = empty(sdf, {rays, 3}, dtype), depth_out = empty(sdf, {rays}, dtype);
  Tensor sdf_out = empty(sdf, {rays, count}, dtype), t_out = empty(sdf, {rays, count}, dtype);
  dispatch_floating(name, sdf, [&](auto zero) {
    using T = decltype(zero);
    spslam::rendering_losses_backward(scope.context, samples.table<T>(), targets.inputs<T>(), data<T>(grad),
                                      mutable_data<T>(color_out), mutable_data<T>(depth_out), mutable_data<T>(sdf_out),
                                      mutable_data<T>(t_out));
  });
  return {color_out, depth_out, sdf_out, t_out};
}

}  // namespace

#ifndef SPS_CUDA
STABLE_TORCH_LIBRARY_FRAGMENT(spslam, m) {
  m.def(
      "volume_render(Tensor sdf, Tensor color, Tensor t, Tensor valid, float truncation) -> (Tensor, Tensor, Tensor)");
  m.def(
      "volume_render_backward(Tensor grad_color, Tensor grad_depth, Tensor? grad_weights, Tensor sdf, Tensor color, "
      "Tensor t, Tensor valid, Tensor weights, float truncation) -> (Tensor, Tensor, Tensor)");
  m.def(
      "rendering_losses(Tensor color, Tensor depth, Tensor sdf, Tensor t, Tensor valid, Tensor rendered, "
      "Tensor target_color, Tensor target_depth, Tensor cosine, float truncation, bool cosine_targets) -> Tensor");
  m.def(
      "rendering_losses_backward(Tensor grad, Tensor color, Tensor depth, Tensor sdf, Tensor t, Tensor valid, "
      "Tensor rendered, Tensor target_color, Tensor target_depth, Tensor cosine, float truncation, "
      "bool cosine_targets) -> (Tensor, Tensor, Tensor, Tensor)");
}
#endif

SPS_LIBRARY_IMPL(m) {
  m.impl("volume_render", TORCH_BOX(&volume_render));
  m.impl("volume_render_backward", TORCH_BOX(&volume_render_backward));
  m.impl("rendering_losses", TORCH_BOX(&rendering_losses));
  m.impl("rendering_losses_backward", TORCH_BOX(&rendering_losses_backward));
}

}  // namespace spslam::bindings
