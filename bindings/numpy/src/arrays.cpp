#include "arrays.h"

namespace spslam::numpy {
namespace {

std::string message(const Argument& argument, const std::string& rule, const std::string& actual) {
  return std::string(argument.function) + ": " + argument.name + " must " + rule + ", got " + actual;
}

std::string brackets(const std::vector<std::string>& names) {
  std::string text = "[";
  for (std::size_t i = 0; i < names.size(); ++i) text += (i ? ", " : "") + names[i];
  return text + "]";
}

}  // namespace

void refuse_value(const Argument& argument, const std::string& rule, const std::string& actual) {
  throw py::value_error(message(argument, rule, actual));
}

void refuse_type(const Argument& argument, const std::string& rule, const std::string& actual) {
  throw py::type_error(message(argument, rule, actual));
}

std::string dtype_name(const py::array& array) {
  return py::cast<std::string>(py::str(array.dtype()));
}

bool is_plain(const py::array& array) {
  const int needed = py::detail::npy_api::NPY_ARRAY_C_CONTIGUOUS_ | py::detail::npy_api::NPY_ARRAY_ALIGNED_;
  return (array.flags() & needed) == needed;
}

py::array checked_array(const Argument& argument, const py::object& object, const Shape& shape) {
  if (!py::isinstance<py::array>(object)) {
    refuse_type(argument, "be a numpy.ndarray", py::cast<std::string>(py::type::of(object).attr("__name__")));
  }
  py::array array = py::reinterpret_borrow<py::array>(object);
  bool fits = array.ndim() == static_cast<py::ssize_t>(shape.size());
  std::vector<std::string> wanted, actual;
  for (std::size_t i = 0; i < shape.size(); ++i) {
    wanted.push_back(shape[i].name);
    fits = fits && (shape[i].size < 0 || array.shape(static_cast<py::ssize_t>(i)) == shape[i].size);
  }
  for (py::ssize_t i = 0; i < array.ndim(); ++i) actual.push_back(std::to_string(array.shape(i)));
  if (!fits) refuse_value(argument, "have shape " + brackets(wanted), brackets(actual));
  return array;
}

}  // namespace spslam::numpy
