// Functions that a compiler vectorizes on the host: the C library's are one call per element.
#pragma once

#include <cmath>
#include <cstdint>

#include "core/macros.h"

namespace spslam {

// The smaller and the larger of two; `b` where one is NaN. Unlike std::fmin and std::fmax no calls, so they vectorize.
template <class T>
SPS_INLINE T smaller(T a, T b) {
  return a < b ? a : b;
}

template <class T>
SPS_INLINE T larger(T a, T b) {
  return a > b ? a : b;
}

// e^x for float: within 2 ulp, NaN kept; saturates near 2^-126 and 2^127 where the C library underflows or overflows.
SPS_INLINE float exponential(float x) {
#if defined(__CUDA_ARCH__)
  return ::expf(x);
#else
  // x = n ln 2 + r. Adding 1.5 * 2^23 rounds to the integer n and leaves it in the low bits.
  constexpr float kLog2E = 1.44269504f, kRound = 12582912.0f, kLn2High = 0.693359375f, kLn2Low = -2.12194440e-4f;
  x = x < -87.0f ? -87.0f : (x > 88.0f ? 88.0f : x);
  const float shifted = x * kLog2E + kRound;
  const float n = shifted - kRound;
  const float r = (x - n * kLn2High) - n * kLn2Low;
  float p = 1.9875691500e-4f;
  p = p * r + 1.3981999507e-3f;
  p = p * r + 8.3334519073e-3f;
  p = p * r + 4.1665795894e-2f;
  p = p * r + 1.6666665459e-1f;
  p = p * r + 5.0000001201e-1f;
  p = p * (r * r) + r + 1.0f;
  std::uint32_t bits;
  __builtin_memcpy(&bits, &shifted, sizeof bits);
  bits = (bits << 23) + 0x3f800000u;
  float scale;
  __builtin_memcpy(&scale, &bits, sizeof scale);
  return p * scale;
#endif
}

SPS_INLINE double exponential(double x) {
  return ::exp(x);
}

template <class T>
SPS_INLINE T sigmoid(T x) {
  const T e = exponential(-std::fabs(x));
  const T d = 1 / (1 + e);
  return x < 0 ? e * d : d;
}

// tanh, within 3 ulp for float.
template <class T>
SPS_INLINE T hyperbolic_tangent(T x) {
  const T a = std::fabs(x);
  const T e = exponential(-2 * a);
  const T x2 = x * x;
  const T far = (1 - e) / (1 + e);
  // Below 1/4, where 1 - e cancels, a series: good for float, too short for double, which takes the C library's.
  const T near = a * (1 + x2 * (T(-1.0 / 3) + x2 * (T(2.0 / 15) + x2 * (T(-17.0 / 315) + x2 * T(62.0 / 2835)))));
  const T y = a < T(0.25) ? near : far;
  return x < 0 ? -y : y;
}

template <>
SPS_INLINE double hyperbolic_tangent(double x) {
  return ::tanh(x);
}

}  // namespace spslam
