#include "spslam/optimizer.h"

#include "bindings/common.h"

namespace spslam::bindings {
namespace {

void sparse_adam_(Tensor param, Tensor grad, Tensor exp_avg, Tensor exp_avg_sq, std::optional<Tensor> stamps,
                  std::int64_t stamp, double lr, double beta1, double beta2, double eps, std::int64_t step) {
  DeviceScope scope(param);
  const std::int64_t count = param.numel();
  SPS_CHECK(same_shape(grad, param) && same_shape(exp_avg, param) && same_shape(exp_avg_sq, param),
            "sparse_adam_: grad, exp_avg and exp_avg_sq must have the shape of param");
  SPS_CHECK(step >= 1, "sparse_adam_: step must be at least 1, got ", step);
  if (count == 0) return;
  std::optional<Tensor> flat_stamps;
  if (stamps.has_value()) flat_stamps = as_contiguous(*stamps);
  const std::int64_t rows = stamps.has_value() ? stamps->numel() : 1;
  SPS_CHECK(rows >= 1 && count % rows == 0, "sparse_adam_: stamps must have one entry per row of param");
  dispatch_floating("sparse_adam_", param, [&](auto zero) {
    using T = decltype(zero);
    sparse_adam(scope.context, AdamStep{lr, beta1, beta2, eps, step}, rows, count / rows,
                flat_stamps.has_value() ? data<std::int32_t>(*flat_stamps) : nullptr,
                to_int32("sparse_adam_", "stamp", stamp), mutable_data<T>(param), mutable_data<T>(grad),
                mutable_data<T>(exp_avg), mutable_data<T>(exp_avg_sq));
  });
}

std::tuple<Tensor, Tensor, Tensor> normal_equations(Tensor residuals, Tensor jacobians, Tensor weights) {
  DeviceScope scope(residuals);
  SPS_CHECK(residuals.dim() == 2, "normal_equations: residuals must have shape [F, N]");
  const std::int64_t frames = residuals.size(0), count = residuals.size(1);
  SPS_CHECK(has_shape(jacobians, {frames, count, 6}) && same_shape(weights, residuals),
            "normal_equations: jacobians and weights must fit residuals");
  check_count("normal_equations", "frames", frames, 0);
  check_count("normal_equations", "residuals of a frame", count, 0);
  residuals = as_contiguous(residuals);
  jacobians = as_contiguous(jacobians);
  weights = as_contiguous(weights);
  Tensor partials = empty(residuals, {normal_equations_partials(frames, count)}, ScalarType::Double);
  Tensor hessian = empty(residuals, {frames, 6, 6}, residuals.scalar_type());
  Tensor gradient = empty(residuals, {frames, 6}, residuals.scalar_type());
  Tensor cost = empty(residuals, {frames}, residuals.scalar_type());
  dispatch_floating("normal_equations", residuals, [&](auto zero) {
    using T = decltype(zero);
    spslam::normal_equations(scope.context, frames, count, data<T>(residuals), data<T>(jacobians), data<T>(weights),
                             mutable_data<double>(partials), mutable_data<T>(hessian), mutable_data<T>(gradient),
                             mutable_data<T>(cost));
  });
  return {hessian, gradient, cost};
}

Tensor solve_normal_equations(Tensor hessian, Tensor gradient, double damping, double absolute_damping) {
  DeviceScope scope(hessian);
  SPS_CHECK(has_shape(gradient, {-1, 6}) && has_shape(hessian, {gradient.size(0), 6, 6}),
            "solve_normal_equations: hessian and gradient must have shapes [F, 6, 6] and [F, 6]");
  hessian = as_contiguous(hessian);
  gradient = as_contiguous(gradient);
  Tensor delta = empty(gradient, {gradient.size(0), 6}, gradient.scalar_type());
  dispatch_floating("solve_normal_equations", hessian, [&](auto zero) {
    using T = decltype(zero);
    spslam::solve_normal_equations(scope.context, gradient.size(0), data<T>(hessian), data<T>(gradient), damping,
                                   absolute_damping, mutable_data<T>(delta));
  });
  return delta;
}

}  // namespace

#ifndef SPS_CUDA
STABLE_TORCH_LIBRARY_FRAGMENT(spslam, m) {
  m.def(
      "sparse_adam_(Tensor(a!) param, Tensor(b!) grad, Tensor(c!) exp_avg, Tensor(d!) exp_avg_sq, Tensor? stamps, "
      "int stamp, float lr, float beta1, float beta2, float eps, int step) -> ()");
  m.def("normal_equations(Tensor residuals, Tensor jacobians, Tensor weights) -> (Tensor, Tensor, Tensor)");
  m.def("solve_normal_equations(Tensor hessian, Tensor gradient, float damping, float absolute_damping) -> Tensor");
}
#endif

SPS_LIBRARY_IMPL(m) {
  m.impl("sparse_adam_", TORCH_BOX(&sparse_adam_));
  m.impl("normal_equations", TORCH_BOX(&normal_equations));
  m.impl("solve_normal_equations", TORCH_BOX(&solve_normal_equations));
}

}  // namespace spslam::bindings
