// What every binding shares: tensor access, last checks, device context. LibTorch's stable ABI only; each binding
// file is compiled once for the CPU library and, with SPS_CUDA, once for the CUDA library.
#pragma once

#ifdef SPS_CUDA
#include <cuda_runtime_api.h>
#endif

#include <torch/csrc/stable/accelerator.h>
#include <torch/csrc/stable/library.h>
#include <torch/csrc/stable/macros.h>
#include <torch/csrc/stable/ops.h>
#include <torch/csrc/stable/tensor.h>
#include <torch/headeronly/core/ScalarType.h>
#include <torch/headeronly/util/Exception.h>

#include <cstdint>
#include <exception>
#include <initializer_list>
#include <optional>
#include <sstream>
#include <stdexcept>
#include <tuple>
#include <vector>

#include "core/device.h"
#include "core/philox.h"
#include "spslam/types/camera.h"

namespace spslam::bindings {

using torch::headeronly::ScalarType;
using torch::stable::Tensor;

template <class... Words>
[[noreturn]] void fail(const Words&... words) {
  std::ostringstream text;
  (text << ... << words);
  throw std::runtime_error(text.str());
}

// Unless `condition` holds, throws a RuntimeError with this message alone: torch's own check begins with a file name of
// the machine that built it.
#define SPS_CHECK(condition, ...)                          \
  do {                                                     \
    if (!(condition)) spslam::bindings::fail(__VA_ARGS__); \
  } while (false)

// Most rays, points or iterations of a call: their products with sizes of records stay within 64 bits.
constexpr std::int64_t kMaxCount = std::int64_t{1} << 30;

// Whether a tensor has that shape, -1 standing for any size. Sizes are compared one by one: of a tensor without memory,
// such as one of 0 columns, they may be of any size, and so may their products.
inline bool has_shape(const Tensor& tensor, std::initializer_list<std::int64_t> shape) {
  if (tensor.dim() != static_cast<std::int64_t>(shape.size())) return false;
  std::int64_t axis = 0;
  for (const std::int64_t size : shape) {
    if (size != -1 && tensor.size(axis) != size) return false;
    ++axis;
  }
  return true;
}

inline bool same_shape(const Tensor& tensor, const Tensor& other) {
  if (tensor.dim() != other.dim()) return false;
  for (std::int64_t axis = 0; axis < tensor.dim(); ++axis) {
    if (tensor.size(axis) != other.size(axis)) return false;
  }
  return true;
}

// The tensor, or a contiguous copy of it. Nearly all are contiguous, which is known at once; torch's own function looks
// itself up by its name in each call.
inline Tensor as_contiguous(const Tensor& tensor) {
  return tensor.is_contiguous() ? tensor : torch::stable::contiguous(tensor);
}

inline std::vector<Tensor> all_contiguous(const std::vector<Tensor>& tensors) {
  std::vector<Tensor> result;
  for (const Tensor& tensor : tensors) result.push_back(as_contiguous(tensor));
  return result;
}

// A number that kernels hold in 32 bits.
inline std::int32_t to_int32(const char* function, const char* argument, std::int64_t value) {
  SPS_CHECK(value >= INT32_MIN && value <= INT32_MAX, function, ": ", argument, " must fit 32 bits, got ", value);
  return static_cast<std::int32_t>(value);
}

inline void check_count(const char* function, const char* argument, std::int64_t count, std::int64_t least = 1) {
  SPS_CHECK(count >= least && count <= kMaxCount, function, ": ", argument, " must be in [", least, ", 2^30], got ",
            count);
}

#ifdef SPS_CUDA
#define SPS_DISPATCH_KEY CUDA
using Context = Cuda;

// Makes the tensor's device current and names its current stream.
class DeviceScope {
 public:
  explicit DeviceScope(const Tensor& tensor) : guard_(tensor.get_device_index()) {
    TORCH_ERROR_CODE_CHECK(aoti_torch_get_current_cuda_stream(tensor.get_device_index(), &context.stream));
  }
  // Reports a failed launch, unless an exception that is already on its way says more.
  ~DeviceScope() noexcept(false) {
    if (std::uncaught_exceptions() == 0) STD_CUDA_KERNEL_LAUNCH_CHECK();
  }
  Context context{nullptr};

 private:
  torch::stable::accelerator::DeviceGuard guard_;
};

#else
#define SPS_DISPATCH_KEY CPU
using Context = Cpu;

class DeviceScope {
 public:
  explicit DeviceScope(const Tensor&) {}
  Context context;
};
#endif

template <class T>
struct ScalarTypeOf;
template <>
struct ScalarTypeOf<float> {
  static constexpr ScalarType value = ScalarType::Float;
};
template <>
struct ScalarTypeOf<double> {
  static constexpr ScalarType value = ScalarType::Double;
};
template <>
struct ScalarTypeOf<std::int32_t> {
  static constexpr ScalarType value = ScalarType::Int;
};
template <>
struct ScalarTypeOf<std::int64_t> {
  static constexpr ScalarType value = ScalarType::Long;
};
template <>
struct ScalarTypeOf<bool> {
  static constexpr ScalarType value = ScalarType::Bool;
};
template <>
struct ScalarTypeOf<std::uint8_t> {
  static constexpr ScalarType value = ScalarType::Byte;
};
template <>
struct ScalarTypeOf<std::uint16_t> {
  static constexpr ScalarType value = ScalarType::UInt16;
};

// Read access. The tensor must be contiguous: take it through as_contiguous() first.
template <class T>
const T* data(const Tensor& tensor) {
  SPS_CHECK(tensor.scalar_type() == ScalarTypeOf<T>::value, "spslam: tensor of another dtype than the kernel reads");
  return static_cast<const T*>(tensor.const_data_ptr());
}

// Write access to an output or an in-place argument.
template <class T>
T* mutable_data(const Tensor& tensor) {
  SPS_CHECK(tensor.scalar_type() == ScalarTypeOf<T>::value, "spslam: tensor of another dtype than the kernel writes");
  SPS_CHECK(tensor.is_contiguous(), "spslam: an in-place argument must be contiguous");
  return static_cast<T*>(tensor.mutable_data_ptr());
}

inline Tensor empty(const Tensor& like, const std::vector<std::int64_t>& sizes, ScalarType dtype) {
  return torch::stable::new_empty(like, sizes, dtype);
}

inline Tensor zeros(const Tensor& like, const std::vector<std::int64_t>& sizes, ScalarType dtype) {
  return torch::stable::new_zeros(like, sizes, dtype);
}

// Calls f with a value of the element type, float or double.
template <class F>
void dispatch_floating(const char* function, const Tensor& tensor, F&& f) {
  if (tensor.scalar_type() == ScalarType::Float) {
    f(float{});
  } else if (tensor.scalar_type() == ScalarType::Double) {
    f(double{});
  } else {
    SPS_CHECK(false, function, ": tensors must be float32 or float64");
  }
}

// Scratch memory for a kernel, on the device of a tensor and freed with this.
class Scratch {
 public:
  explicit Scratch(const Tensor& like) : like_(like) {}

  void* operator()(std::int64_t bytes) {
    regions_.push_back(empty(like_, {bytes}, ScalarType::Byte));
    return mutable_data<std::uint8_t>(regions_.back());
  }

 private:
  Tensor like_;
  std::vector<Tensor> regions_;
};

inline PhiloxKey philox_key(std::int64_t seed, std::int64_t stream, std::int64_t frame, std::int64_t iteration) {
  return {static_cast<std::uint64_t>(seed), static_cast<std::uint32_t>(stream), static_cast<std::uint32_t>(frame),
          static_cast<std::uint32_t>(iteration)};
}

inline Intrinsics load_intrinsics(const char* function, const std::vector<double>& values) {
  SPS_CHECK(values.size() == 4, function, ": intrinsics must be fx, fy, cx, cy");
  return {static_cast<float>(values[0]), static_cast<float>(values[1]), static_cast<float>(values[2]),
          static_cast<float>(values[3])};
}

}  // namespace spslam::bindings

#define SPS_LIBRARY_IMPL(m) SPS_LIBRARY_IMPL_(SPS_DISPATCH_KEY, m)
#define SPS_LIBRARY_IMPL_(key, m) STABLE_TORCH_LIBRARY_IMPL(spslam, key, m)
