// One unit of a small network: activations, and the sums a unit and its gradients are made of.
#pragma once

#include <cstdint>

#include "core/macros.h"
#include "core/math.h"
#include "spslam/decoders.h"

namespace spslam {

// ReLU that lets NaN pass.
template <class T>
SPS_INLINE T rectified(T x) {
  return x < 0 ? T(0) : x;
}

// The gradient before a ReLU whose output was `y`.
template <class T>
SPS_INLINE T rectified_gradient(T y, T grad) {
  return y <= 0 ? T(0) : grad;
}

template <class T>
SPS_INLINE T activate(MlpActivation activation, T x) {
  if (activation == MlpActivation::kTanh) return hyperbolic_tangent(x);
  if (activation == MlpActivation::kSigmoid) return sigmoid(x);
  return x;
}

// d activation / d its input, from its output.
template <class T>
SPS_INLINE T activation_slope(MlpActivation activation, T y) {
  if (activation == MlpActivation::kTanh) return 1 - y * y;
  if (activation == MlpActivation::kSigmoid) return y * (1 - y);
  return 1;
}

// bias + w . x
template <class T>
SPS_INLINE T unit(const T* w, const T* x, std::int64_t size, T bias) {
  T sum = bias;
  for (std::int64_t i = 0; i < size; ++i) sum += w[i] * x[i];
  return sum;
}

// sum_o g[o] * w[o * stride]: the gradient of one input of a layer.
template <class T>
SPS_INLINE T input_gradient(const T* g, const T* w, std::int64_t outputs, std::int64_t stride) {
  T sum = 0;
  for (std::int64_t o = 0; o < outputs; ++o) sum += g[o] * w[o * stride];
  return sum;
}

}  // namespace spslam
