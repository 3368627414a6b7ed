// NumPy arrays as the kernels take them: checked in the wording of spslam.ops, not copied where they are contiguous.
#pragma once

#include <pybind11/numpy.h>
#include <pybind11/pybind11.h>

#include <cstdint>
#include <string>
#include <type_traits>
#include <vector>

#include "spslam/core/device.h"

namespace spslam::numpy {

namespace py = pybind11;

constexpr Cpu kCpu{};

// One axis of an expected shape: a size, or a name where any will do.
struct Axis {
  Axis(const char* name) : size(-1), name(name) {}
  Axis(std::int64_t size) : size(size), name(std::to_string(size)) {}
  Axis(int size) : Axis(static_cast<std::int64_t>(size)) {}
  std::int64_t size;
  std::string name;
};
using Shape = std::vector<Axis>;

// Where an argument stands, for messages.
struct Argument {
  const char* function;
  const char* name;
};

[[noreturn]] void refuse_value(const Argument& argument, const std::string& rule, const std::string& actual);
[[noreturn]] void refuse_type(const Argument& argument, const std::string& rule, const std::string& actual);

template <class Number>
void check(bool condition, const Argument& argument, const std::string& rule, Number actual) {
  if (condition) return;
  if constexpr (std::is_integral_v<Number>) {
    refuse_value(argument, rule, std::to_string(actual));
  } else if constexpr (std::is_same_v<Number, std::string>) {
    refuse_value(argument, rule, actual);
  } else {
    refuse_value(argument, rule, py::cast<std::string>(py::repr(py::float_(actual))));
  }
}

py::array checked_array(const Argument& argument, const py::object& object, const Shape& shape);
std::string dtype_name(const py::array& array);
bool is_plain(const py::array& array);  // contiguous, aligned, of this machine's byte order

template <class T>
const char* name_of() {
  if constexpr (std::is_same_v<T, float>) return "float32";
  if constexpr (std::is_same_v<T, double>) return "float64";
  if constexpr (std::is_same_v<T, std::int32_t>) return "int32";
  if constexpr (std::is_same_v<T, std::int64_t>) return "int64";
  if constexpr (std::is_same_v<T, bool>) return "bool";
}

template <class T>
py::array typed_array(const Argument& argument, const py::object& object, const Shape& shape) {
  py::array array = checked_array(argument, object, shape);
  if (!py::isinstance<py::array_t<T>>(array)) {
    refuse_type(argument, std::string("be ") + name_of<T>(), dtype_name(array));
  }
  return array;
}

// An array that is read. One that is not contiguous is copied, as the torch ops do.
template <class T>
class Input {
 public:
  Input(const Argument& argument, const py::object& object, const Shape& shape)
      : array_(typed_array<T>(argument, object, shape)) {
    if (!is_plain(array_)) array_ = py::array_t<T, py::array::c_style>(array_.attr("copy")("C"));
  }
  const T* data() const { return static_cast<const T*>(array_.data()); }
  std::int64_t size(int axis) const { return array_.shape(axis); }
  std::int64_t numel() const { return array_.size(); }

 private:
  py::array array_;
};

// An array that is changed where it lies.
template <class T>
class InOut {
 public:
  InOut(const Argument& argument, const py::object& object, const Shape& shape)
      : array_(typed_array<T>(argument, object, shape)) {
    if (!is_plain(array_)) refuse_value(argument, "be contiguous", "strides " + strides());
    if (!array_.writeable()) refuse_value(argument, "be writeable", "a read-only array");
  }
  T* data() { return static_cast<T*>(array_.mutable_data()); }
  std::int64_t size(int axis) const { return array_.shape(axis); }
  std::int64_t numel() const { return array_.size(); }

 private:
  std::string strides() const { return py::cast<std::string>(py::str(array_.attr("strides"))); }
  py::array array_;
};

template <class T>
py::array_t<T> empty(const std::vector<py::ssize_t>& shape) {
  return py::array_t<T>(shape);
}

// Calls f with a value of the floating type of `object`.
template <class F>
py::object dispatch_floating(const Argument& argument, const py::object& object, const F& f) {
  if (py::isinstance<py::array_t<float>>(object)) return f(float{});
  if (py::isinstance<py::array_t<double>>(object)) return f(double{});
  if (!py::isinstance<py::array>(object)) checked_array(argument, object, {});
  refuse_type(argument, "be float32 or float64", dtype_name(py::reinterpret_borrow<py::array>(object)));
}

// Runs a kernel while other Python threads may run.
template <class F>
auto without_gil(const F& f) {
  py::gil_scoped_release release;
  return f();
}

void define_voxel_hash(py::module_& m);
void define_interpolation(py::module_& m);
void define_ray_sampling(py::module_& m);
void define_volume_rendering(py::module_& m);
void define_decoders(py::module_& m);
void define_optimizer(py::module_& m);
void define_prior_fusion(py::module_& m);
void define_marching_cubes(py::module_& m);

}  // namespace spslam::numpy
