// Opacity, weight and gradients of one sample of a ray that is composited front to back.
#pragma once

#include <cmath>
#include <cstdint>

#include "core/macros.h"
#include "core/math.h"
#include "spslam/alpha_composite.h"

namespace spslam {

// Shares of the light that reaches a sample: what it stops and what it lets pass.
template <class T>
struct SampleOpacity {
  T alpha, pass;
};

// 1 - e^-x: a series where that cancels.
SPS_INLINE float one_minus_exponential(float x, float e) {
  const float near = x * (1 - x * (1.0f / 2) * (1 - x * (1.0f / 3) * (1 - x * 0.25f * (1 - x * 0.2f * (1 - x / 6)))));
  return std::fabs(x) < 0.25f ? near : 1 - e;
}
SPS_INLINE double one_minus_exponential(double x, double) {
  return -::expm1(-x);
}

// A sample's opacity, from its alpha, or from its density and the length of ray that it stands for.
template <class T>
SPS_INLINE SampleOpacity<T> sample_opacity(T alpha) {
  return {alpha, 1 - alpha};
}
template <class T>
SPS_INLINE SampleOpacity<T> sample_opacity(T density, T length) {
  const T x = density * length, e = exponential(-x);
  return {one_minus_exponential(x, e), e};
}

// Whether enough light reaches a sample for it to take part. NaN does, to be seen; a stop of 0 is none, so that an
// alpha slightly above 1 by rounding changes nothing.
template <class T>
SPS_INLINE bool takes_part(T transmittance, T stop) {
  return !(stop > 0 && transmittance < stop);
}

struct RaySpan {
  std::int64_t first, count;
  bool valid;
};

SPS_INLINE RaySpan ray_span(const RaySpans& spans, std::int64_t r) {
  if (!spans.packed_info) {
    const std::int64_t count = spans.num_samples / spans.num_rays;
    return {r * count, count, true};
  }
  const std::int64_t first = spans.packed_info[2 * r], count = spans.packed_info[2 * r + 1];
  const bool valid = first >= 0 && count >= 0 && first <= spans.num_samples && count <= spans.num_samples - first;
  return {valid ? first : 0, valid ? count : 0, valid};
}

// d loss / d alpha of a sample that the share `transmittance` reaches, from that by its weight, and that by the light
// that it lets pass: sum_{j > i} (d loss / d w_j) alpha_j prod_{i < k < j} (1 - alpha_k). Without a division, so that
// an alpha of 1 has its gradient.
template <class T>
SPS_INLINE T alpha_gradient(T transmittance, T grad_weight, T grad_passed) {
  return transmittance * (grad_weight - grad_passed);
}

// d alpha / d density is pass * length, and d alpha / d length is pass * density.
template <class T>
SPS_INLINE T optical_depth_gradient(T grad_alpha, T pass) {
  return grad_alpha * pass;
}

}  // namespace spslam
