#include "spslam/decoders.h"

#include "arrays.h"

namespace spslam::numpy {
namespace {

constexpr std::int64_t kMaxWidth = std::int64_t{1} << 30;  // so that the number of parameters fits 64 bits

void check_width(const Argument& argument, std::int64_t width) {
  check(width >= 1, argument, "be at least 1", width);
  check(width <= kMaxWidth, argument, "be at most 2^30", width);
}

MlpShape checked_shape(const char* name, std::int64_t inputs, std::int64_t hidden, std::int64_t output,
                       std::int64_t activation) {
  check_width({name, "hidden"}, hidden);
  check_width({name, "output"}, output);
  check(inputs <= kMaxWidth, {name, "input"}, "have at most 2^30 columns", inputs);
  check(activation >= 0 && activation <= 2, {name, "activation"}, "be 0, 1 or 2", activation);
  return {inputs, hidden, output, static_cast<MlpActivation>(activation)};
}

py::object forward(const py::object& input, const py::object& params, std::int64_t hidden, std::int64_t output,
                   std::int64_t activation) {
  const char* name = "mlp";
  return dispatch_floating({name, "input"}, input, [&](auto zero) -> py::object {
    using T = decltype(zero);
    const Input<T> x({name, "input"}, input, {"N", "I"});
    const MlpShape shape = checked_shape(name, x.size(1), hidden, output, activation);
    const Input<T> p({name, "params"}, params, {shape.num_params()});
    std::vector<T> workspace(mlp_workspace_size(kCpu, shape, x.size(0)));
    auto out = empty<T>({x.size(0), output});
    T* y = out.mutable_data();
    without_gil([&] { mlp(kCpu, shape, x.data(), x.size(0), p.data(), workspace.data(), y); });
    return out;
  });
}

py::object backward(const py::object& grad, const py::object& input, const py::object& params, std::int64_t hidden,
                    std::int64_t output, std::int64_t activation) {
  const char* name = "mlp_backward";
  return dispatch_floating({name, "input"}, input, [&](auto zero) -> py::object {
    using T = decltype(zero);
    const Input<T> x({name, "input"}, input, {"N", "I"});
    const MlpShape shape = checked_shape(name, x.size(1), hidden, output, activation);
    const Input<T> p({name, "params"}, params, {shape.num_params()}), g({name, "grad"}, grad, {x.size(0), output});
    std::vector<T> workspace(mlp_backward_workspace_size(kCpu, shape, x.size(0)));
    auto grad_input = empty<T>({x.size(0), x.size(1)}), grad_params = empty<T>({shape.num_params()});
    T *gx = grad_input.mutable_data(), *gp = grad_params.mutable_data();
    without_gil([&] { mlp_backward(kCpu, shape, g.data(), x.data(), x.size(0), p.data(), workspace.data(), gx, gp); });
    return py::make_tuple(grad_input, grad_params);
  });
}

std::int64_t num_params(std::int64_t inputs, std::int64_t hidden, std::int64_t outputs) {
  const char* name = "mlp_num_params";
  check_width({name, "inputs"}, inputs);
  check_width({name, "hidden"}, hidden);
  check_width({name, "outputs"}, outputs);
  return MlpShape{inputs, hidden, outputs, MlpActivation::kNone}.num_params();
}

}  // namespace

void define_decoders(py::module_& m) {
  m.def("mlp_num_params", &num_params, py::arg("inputs"), py::arg("hidden"), py::arg("outputs"),
        "Length of the flat parameter vector of mlp.");
  m.def("mlp", &forward, py::arg("input"), py::arg("params"), py::arg("hidden"), py::arg("output"),
        py::arg("activation") = 0,
        "[N, output] of a network input -> hidden -> hidden -> output with ReLU between; params flat as W1 b1 W2 b2 W3 "
        "b3, row-major; activation at the end: 0 none, 1 tanh, 2 sigmoid.");
  m.def("mlp_backward", &backward, py::arg("grad"), py::arg("input"), py::arg("params"), py::arg("hidden"),
        py::arg("output"), py::arg("activation") = 0, "Gradients of input and params from grad [N, output].");
}

}  // namespace spslam::numpy
