// Sums of floating-point terms as 64-bit integers on CUDA: integer addition gives the same bits in any order.
#pragma once

#include <cstdint>

#include "core/for_each.h"

namespace spslam {

// Raises *bits, the bit pattern of a non-negative double, to |x| at least. NaN is above all numbers.
__device__ inline void atomic_max_abs(std::int64_t* bits, double x) {
  atomicMax(reinterpret_cast<unsigned long long*>(bits),
            static_cast<unsigned long long>(__double_as_longlong(fabs(x))));
}

// Scale of sums of at most num_terms terms of at most the size in *largest: no partial sum can overflow, with four bits
// to spare for weights above one. If a term is not finite, or too large all the same, every sum becomes NaN.
class FixedPoint {
 public:
  __device__ FixedPoint(std::int64_t* largest_bits, std::int64_t num_terms) : largest_bits_(largest_bits) {
    const double largest = __longlong_as_double(*largest_bits);
    finite_ = largest <= 1.7976931348623157e308;
    const int bits = 64 - __clzll(num_terms) + (finite_ && largest > 0 ? ilogb(largest) + 1 : 0);
    exponent_ = 58 - bits < 1000 ? 58 - bits : 1000;
    scale_ = scalbn(1.0, exponent_);
  }

  __device__ void add(std::int64_t* sum, double term) const {
    const double scaled = term * scale_;
    if (!(fabs(scaled) < 9.2e18)) return atomic_max_abs(largest_bits_, nan(""));
    atomicAdd(reinterpret_cast<unsigned long long*>(sum), static_cast<unsigned long long>(__double2ll_rn(scaled)));
  }

  __device__ double value(std::int64_t sum) const {
    return finite_ ? scalbn(static_cast<double>(sum), -exponent_) : nan("");
  }

 private:
  std::int64_t* largest_bits_;
  double scale_;
  int exponent_;
  bool finite_;
};

namespace detail {
template <class Value>
__global__ void max_abs_kernel(std::int64_t n, Value value, std::int64_t* bits) {
  double largest = 0;
  const std::int64_t stride = static_cast<std::int64_t>(gridDim.x) * blockDim.x;
  for (std::int64_t i = blockIdx.x * static_cast<std::int64_t>(blockDim.x) + threadIdx.x; i < n; i += stride) {
    const double a = fabs(static_cast<double>(value(i)));
    largest = a <= largest || largest != largest ? largest : a;  // keeps a NaN
  }
  for (int offset = 16; offset; offset /= 2) {
    const double other = __shfl_xor_sync(0xffffffffu, largest, offset);
    largest = other <= largest || largest != largest ? largest : other;
  }
  if (threadIdx.x % 32 == 0) atomic_max_abs(bits, largest);
}
}  // namespace detail

// *bits (zero before) becomes the bit pattern of the largest |value(i)| as a double, NaN where one is.
template <class Value>
void max_abs_of(Cuda device, std::int64_t n, const Value& value, std::int64_t* bits) {
  if (n == 0) return;
  constexpr int kThreads = 256, kMaxBlocks = 1024;
  const std::int64_t blocks = (n + kThreads - 1) / kThreads;
  detail::max_abs_kernel<<<static_cast<int>(blocks < kMaxBlocks ? blocks : kMaxBlocks), kThreads, 0,
                           static_cast<cudaStream_t>(device.stream)>>>(n, value, bits);
}

template <class T>
void max_abs(Cuda device, std::int64_t n, const T* values, std::int64_t* bits) {
  max_abs_of(device, n, [=] __device__(std::int64_t i) { return values[i]; }, bits);
}

}  // namespace spslam
