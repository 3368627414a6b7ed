#include "spslam/optimizer.h"

#include "arrays.h"

namespace spslam::numpy {
namespace {

void adam(const py::object& param, const py::object& grad, const py::object& exp_avg, const py::object& exp_avg_sq,
          const py::object& stamps, std::int64_t stamp, double lr, std::int64_t step, std::pair<double, double> betas,
          double eps) {
  const char* name = "sparse_adam_";
  check(lr >= 0, {name, "lr"}, "be at least 0", lr);
  check(betas.first >= 0 && betas.first < 1, {name, "betas"}, "be in [0, 1)", betas.first);
  check(betas.second >= 0 && betas.second < 1, {name, "betas"}, "be in [0, 1)", betas.second);
  check(eps >= 0, {name, "eps"}, "be at least 0", eps);
  check(step >= 1, {name, "step"}, "be at least 1", step);
  check(stamp >= INT32_MIN && stamp <= INT32_MAX, {name, "stamp"}, "fit 32 bits", stamp);
  dispatch_floating({name, "param"}, param, [&](auto zero) -> py::object {
    using T = decltype(zero);
    InOut<T> p({name, "param"}, param, {"V", "C"});
    const std::int64_t rows = p.size(0), channels = p.size(1);
    InOut<T> g({name, "grad"}, grad, {rows, channels}), m({name, "exp_avg"}, exp_avg, {rows, channels});
    InOut<T> v({name, "exp_avg_sq"}, exp_avg_sq, {rows, channels});
    T *values = p.data(), *gradients = g.data(), *first = m.data(), *second = v.data();
    const auto run = [&](const std::int32_t* marks) {
      without_gil([&] {
        sparse_adam(kCpu, AdamStep{lr, betas.first, betas.second, eps, step}, rows, channels, marks,
                    static_cast<std::int32_t>(stamp), values, gradients, first, second);
      });
    };
    if (stamps.is_none()) {
      run(nullptr);
    } else {
      run(Input<std::int32_t>({name, "stamps"}, stamps, {rows}).data());
    }
    return py::none();
  });
}

py::object equations(const py::object& residuals, const py::object& jacobians, const py::object& weights) {
  const char* name = "normal_equations";
  return dispatch_floating({name, "residuals"}, residuals, [&](auto zero) -> py::object {
    using T = decltype(zero);
    const Input<T> r({name, "residuals"}, residuals, {"F", "N"});
    const std::int64_t frames = r.size(0), count = r.size(1);
    const Input<T> j({name, "jacobians"}, jacobians, {frames, count, 6}),
        w({name, "weights"}, weights, {frames, count});
    std::vector<double> partials(normal_equations_partials(frames, count));
    auto hessian = empty<T>({frames, 6, 6}), gradient = empty<T>({frames, 6}), cost = empty<T>({frames});
    T *h = hessian.mutable_data(), *g = gradient.mutable_data(), *c = cost.mutable_data();
    without_gil([&] { normal_equations(kCpu, frames, count, r.data(), j.data(), w.data(), partials.data(), h, g, c); });
    return py::make_tuple(hessian, gradient, cost);
  });
}

py::object solve(const py::object& hessian, const py::object& gradient, double damping, double absolute_damping) {
  const char* name = "solve_normal_equations";
  check(damping >= 0, {name, "damping"}, "be at least 0", damping);
  check(absolute_damping >= 0, {name, "absolute_damping"}, "be at least 0", absolute_damping);
  return dispatch_floating({name, "hessian"}, hessian, [&](auto zero) -> py::object {
    using T = decltype(zero);
    const Input<T> h({name, "hessian"}, hessian, {"F", 6, 6}), g({name, "gradient"}, gradient, {h.size(0), 6});
    auto delta = empty<T>({h.size(0), 6});
    T* steps = delta.mutable_data();
    without_gil([&] { solve_normal_equations(kCpu, h.size(0), h.data(), g.data(), damping, absolute_damping, steps); });
    return delta;
  });
}

}  // namespace

void define_optimizer(py::module_& m) {
  m.def("sparse_adam_", &adam, py::arg("param"), py::arg("grad"), py::arg("exp_avg"), py::arg("exp_avg_sq"),
        py::arg("stamps") = py::none(), py::arg("stamp") = 0, py::kw_only(), py::arg("lr"), py::arg("step"),
        py::arg("betas") = std::pair<double, double>(0.9, 0.999), py::arg("eps") = 1e-8,
        "One Adam step in place on the rows of [V, C] whose entry in stamps int32 [V] is `stamp` (all rows for None); "
        "their gradients are set to zero.");
  m.def("normal_equations", &equations, py::arg("residuals"), py::arg("jacobians"), py::arg("weights"),
        "hessian [F, 6, 6], gradient [F, 6] and cost [F] from residuals [F, N], jacobians [F, N, 6], weights [F, N].");
  m.def("solve_normal_equations", &solve, py::arg("hessian"), py::arg("gradient"), py::arg("damping") = 0.0,
        py::arg("absolute_damping") = 0.0,
        "Damped Gauss-Newton steps [F, 6]; 0 where the matrix is not positive definite.");
}

}  // namespace spslam::numpy
