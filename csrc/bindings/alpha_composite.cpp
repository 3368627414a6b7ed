#include "spslam/alpha_composite.h"

#include "bindings/common.h"

namespace spslam::bindings {
namespace {

// The samples of all rays, kept contiguous while a kernel reads them.
struct RaySamples {
  Tensor opacities, values, t;
  std::optional<Tensor> lengths, packed_info;
  bool packed;
  std::int64_t rays, samples, channels;

  RaySamples(const char* function, const Tensor& opacities_, const std::optional<Tensor>& lengths_,
             const Tensor& values_, const Tensor& t_, const std::optional<Tensor>& packed_info_)
      : opacities(as_contiguous(opacities_)),
        values(as_contiguous(values_)),
        t(as_contiguous(t_)),
        packed(packed_info_) {
    const std::int64_t axes = packed ? 1 : 2;
    SPS_CHECK(opacities.dim() == axes && values.dim() == axes + 1 && same_shape(t, opacities), function,
              ": shapes must be [R, S], [R, S, C], [R, S], or with packed_info [N], [N, C], [N]");
    for (std::int64_t axis = 0; axis < axes; ++axis) {
      SPS_CHECK(values.size(axis) == opacities.size(axis), function, ": values must fit the shape of opacities");
    }
    if (lengths_) {
      SPS_CHECK(same_shape(*lengths_, opacities), function, ": lengths must have the shape of opacities");
      lengths = as_contiguous(*lengths_);
    }
    if (packed) {
      SPS_CHECK(has_shape(*packed_info_, {-1, 2}), function, ": packed_info must have shape [R, 2]");
      packed_info = as_contiguous(*packed_info_);
    }
    rays = packed ? packed_info->size(0) : opacities.size(0);
    samples = opacities.numel();
    channels = values.size(axes);
  }

  std::vector<std::int64_t> shape() const { return {opacities.sizes().begin(), opacities.sizes().end()}; }

  template <class T>
  CompositeInputs<T> inputs(double stop) const {
    return {data<T>(opacities),
            lengths ? data<T>(*lengths) : nullptr,
            data<T>(values),
            data<T>(t),
            channels,
            static_cast<T>(stop),
            {packed ? data<std::int64_t>(*packed_info) : nullptr, rays, samples}};
  }

  // Of a tensor with a row for each sample: those outside of all spans stay zero.
  Tensor per_sample(const std::vector<std::int64_t>& sizes) const {
    return packed ? zeros(opacities, sizes, opacities.scalar_type()) : empty(opacities, sizes, opacities.scalar_type());
  }
};

std::tuple<Tensor, Tensor, Tensor, Tensor> alpha_composite(Tensor opacities, std::optional<Tensor> lengths,
                                                           Tensor values, Tensor t, std::optional<Tensor> packed_info,
                                                           double stop) {
  const RaySamples samples("alpha_composite", opacities, lengths, values, t, packed_info);
  DeviceScope scope(opacities);
  const ScalarType dtype = opacities.scalar_type();
  Tensor out_values = empty(opacities, {samples.rays, samples.channels}, dtype);
  Tensor depth = empty(opacities, {samples.rays}, dtype), opacity = empty(opacities, {samples.rays}, dtype);
  Tensor weights = samples.per_sample(samples.shape());
  dispatch_floating("alpha_composite", opacities, [&](auto zero) {
    using T = decltype(zero);
    spslam::alpha_composite(scope.context, samples.inputs<T>(stop),
                            CompositeOutputs<T>{mutable_data<T>(out_values), mutable_data<T>(depth),
                                                mutable_data<T>(opacity), mutable_data<T>(weights)});
  });
  return {out_values, depth, opacity, weights};
}

std::tuple<Tensor, Tensor, Tensor, Tensor> alpha_composite_backward(
    Tensor grad_values, Tensor grad_depth, Tensor grad_opacity, std::optional<Tensor> grad_weights, Tensor opacities,
    std::optional<Tensor> lengths, Tensor values, Tensor t, std::optional<Tensor> packed_info, Tensor weights,
    double stop) {
  const char* name = "alpha_composite_backward";
  const RaySamples samples(name, opacities, lengths, values, t, packed_info);
  SPS_CHECK(has_shape(grad_values, {samples.rays, samples.channels}) && has_shape(grad_depth, {samples.rays}) &&
                has_shape(grad_opacity, {samples.rays}) && same_shape(weights, opacities) &&
                (!grad_weights || same_shape(*grad_weights, opacities)),
            name, ": gradients must fit the outputs");
  DeviceScope scope(opacities);
  grad_values = as_contiguous(grad_values);
  grad_depth = as_contiguous(grad_depth);
  grad_opacity = as_contiguous(grad_opacity);
  if (grad_weights) grad_weights = as_contiguous(*grad_weights);
  weights = as_contiguous(weights);
  std::vector<std::int64_t> shape = samples.shape();
  Tensor to_opacities = samples.per_sample(shape), to_t = samples.per_sample(shape);
  Tensor to_lengths = samples.per_sample(lengths ? shape : std::vector<std::int64_t>{0});
  shape.push_back(samples.channels);
  Tensor to_values = samples.per_sample(shape);
  dispatch_floating(name, opacities, [&](auto zero) {
    using T = decltype(zero);
    const CompositeOutputGradients<T> grad{data<T>(grad_values), data<T>(grad_depth), data<T>(grad_opacity),
                                           grad_weights ? data<T>(*grad_weights) : nullptr};
    const CompositeInputGradients<T> out{mutable_data<T>(to_opacities), lengths ? mutable_data<T>(to_lengths) : nullptr,
                                         mutable_data<T>(to_values), mutable_data<T>(to_t)};
    spslam::alpha_composite_backward(scope.context, samples.inputs<T>(stop), data<T>(weights), grad, out);
  });
  return {to_opacities, to_lengths, to_values, to_t};
}

}  // namespace

#ifndef SPS_CUDA
STABLE_TORCH_LIBRARY_FRAGMENT(spslam, m) {
  m.def(
      "alpha_composite(Tensor opacities, Tensor? lengths, Tensor values, Tensor t, Tensor? packed_info, float stop) "
      "-> (Tensor, Tensor, Tensor, Tensor)");
  m.def(
      "alpha_composite_backward(Tensor grad_values, Tensor grad_depth, Tensor grad_opacity, Tensor? grad_weights, "
      "Tensor opacities, Tensor? lengths, Tensor values, Tensor t, Tensor? packed_info, Tensor weights, float stop) "
      "-> (Tensor, Tensor, Tensor, Tensor)");
}
#endif

SPS_LIBRARY_IMPL(m) {
  m.impl("alpha_composite", TORCH_BOX(&alpha_composite));
  m.impl("alpha_composite_backward", TORCH_BOX(&alpha_composite_backward));
}

}  // namespace spslam::bindings
