#include "spslam/decoders.h"

#include "bindings/common.h"

namespace spslam::bindings {
namespace {

MlpShape mlp_shape(const char* function, const Tensor& input, const Tensor& params, std::int64_t hidden,
                   std::int64_t output, std::int64_t activation) {
  SPS_CHECK(activation >= 0 && activation <= 2, function, ": activation must be 0, 1 or 2, got ", activation);
  SPS_CHECK(has_shape(input, {-1, -1}), function, ": input must have shape [N, inputs]");
  check_count(function, "inputs", input.size(1), 0);
  check_count(function, "hidden", hidden);
  check_count(function, "output", output);
  const MlpShape shape{input.size(1), hidden, output, static_cast<MlpActivation>(activation)};
  SPS_CHECK(params.numel() == shape.num_params() && params.scalar_type() == input.scalar_type(), function,
            ": params must have ", shape.num_params(), " elements of input's dtype, got ", params.numel());
  return shape;
}

Tensor mlp(Tensor input, Tensor params, std::int64_t hidden, std::int64_t output, std::int64_t activation) {
  const MlpShape shape = mlp_shape("mlp", input, params, hidden, output, activation);
  input = as_contiguous(input);
  params = as_contiguous(params);
  DeviceScope scope(input);
  const std::int64_t n = input.size(0);
  Tensor out = empty(input, {n, output}, input.scalar_type());
  Tensor workspace = empty(input, {mlp_workspace_size(scope.context, shape, n)}, input.scalar_type());
  dispatch_floating("mlp", input, [&](auto zero) {
    using T = decltype(zero);
    spslam::mlp(scope.context, shape, data<T>(input), n, data<T>(params), mutable_data<T>(workspace),
                mutable_data<T>(out));
  });
  return out;
}

std::tuple<Tensor, Tensor> mlp_backward(Tensor grad, Tensor input, Tensor params, std::int64_t hidden,
                                        std::int64_t output, std::int64_t activation, bool need_grad_input,
                                        bool need_grad_params) {
  const MlpShape shape = mlp_shape("mlp_backward", input, params, hidden, output, activation);
  const std::int64_t n = input.size(0);
  SPS_CHECK(has_shape(grad, {n, output}), "mlp_backward: grad must have shape [N, output]");
  grad = as_contiguous(grad);
  input = as_contiguous(input);
  params = as_contiguous(params);
  DeviceScope scope(input);
  Tensor grad_input = empty(input, {need_grad_input ? n : 0, shape.input}, input.scalar_type());
  Tensor grad_params = empty(input, {need_grad_params ? shape.num_params() : 0}, input.scalar_type());
  Tensor workspace = empty(input, {mlp_backward_workspace_size(scope.context, shape, n)}, input.scalar_type());
  dispatch_floating("mlp_backward", input, [&](auto zero) {
    using T = decltype(zero);
    spslam::mlp_backward(scope.context, shape, data<T>(grad), data<T>(input), n, data<T>(params),
                         mutable_data<T>(workspace), need_grad_input ? mutable_data<T>(grad_input) : nullptr,
                         need_grad_params ? mutable_data<T>(grad_params) : nullptr);
  });
  return {grad_input, grad_params};
}

}  // namespace

#ifndef SPS_CUDA
STABLE_TORCH_LIBRARY_FRAGMENT(spslam, m) {
  m.def("mlp(Tensor input, Tensor params, int hidden, int output, int activation) -> Tensor");
  m.def(
      "mlp_backward(Tensor grad, Tensor input, Tensor params, int hidden, int output, int activation, "
      "bool need_grad_input=True, bool need_grad_params=True) -> (Tensor, Tensor)");
}
#endif

SPS_LIBRARY_IMPL(m) {
  m.impl("mlp", TORCH_BOX(&mlp));
  m.impl("mlp_backward", TORCH_BOX(&mlp_backward));
}

}  // namespace spslam::bindings
