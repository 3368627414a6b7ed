// Depths of the samples along one ray (section III-B).
#pragma once

#include <cstdint>

#include "core/macros.h"
#include "core/philox.h"

namespace spslam {

// Samples s = 0 .. num_uniform-1 are stratified between near and far times the measured depth, the num_surface that
// follow within the truncation distance of it.
template <class T>
struct RaySampling {
  std::int32_t num_uniform, num_surface;
  T near, far;   // shares of the measured depth
  T truncation;  // m

  SPS_INLINE std::int32_t num_samples() const { return num_uniform + num_surface; }
};

// Depth of sample s, drawn with u in [0, 1). Ascending in s within the uniform and within the surface samples.
template <class T>
SPS_INLINE T sample_depth(const RaySampling<T>& sampling, T depth, std::int32_t s, float u) {
  if (s < sampling.num_uniform) {
    const T share = (static_cast<T>(s) + static_cast<T>(u)) / static_cast<T>(sampling.num_uniform);
    return depth * (sampling.near + (sampling.far - sampling.near) * share);
  }
  const T share = (static_cast<T>(s - sampling.num_uniform) + static_cast<T>(u)) / static_cast<T>(sampling.num_surface);
  return depth + sampling.truncation * (2 * share - 1);
}

// The uniform number of sample s of a ray: counter element ray * S + s.
template <class T>
SPS_INLINE float sample_uniform(const PhiloxKey& key, const RaySampling<T>& sampling, std::int64_t ray,
                                std::int32_t s) {
  return philox_uniform(key, static_cast<std::uint32_t>(ray * sampling.num_samples() + s));
}

// Merges two ascending runs into `out`; of equal values those of `a` come first.
template <class T>
SPS_INLINE void merge_ascending(const T* a, std::int32_t count_a, const T* b, std::int32_t count_b, T* out) {
  std::int32_t i = 0, j = 0;
  while (i < count_a && j < count_b) {
    const bool first = a[i] <= b[j];
    out[i + j] = first ? a[i] : b[j];
    i += first;
    j += !first;
  }
  for (; i < count_a; ++i) out[i + j] = a[i];
  for (; j < count_b; ++j) out[i + j] = b[j];
}

// All depths of one ray, ascending; zeros where there is no depth. Draws as it merges, so it needs no buffer.
template <class T>
SPS_INLINE void sample_ray(const PhiloxKey& key, const RaySampling<T>& sampling, std::int64_t ray, T depth, T* out) {
  const std::int32_t count = sampling.num_samples();
  if (!(depth > 0)) {
    for (std::int32_t s = 0; s < count; ++s) out[s] = 0;
    return;
  }
  const auto draw = [&](std::int32_t s) {
    return s < count ? sample_depth(sampling, depth, s, sample_uniform(key, sampling, ray, s)) : T(0);
  };
  std::int32_t i = 0, j = sampling.num_uniform;
  T a = draw(0), b = draw(j);
  for (std::int32_t s = 0; s < count; ++s) {
    const bool first = j == count || (i < sampling.num_uniform && a <= b);
    out[s] = first ? a : b;
    if (first) {
      if (++i < sampling.num_uniform) a = draw(i);
    } else {
      if (++j < count) b = draw(j);
    }
  }
}

}  // namespace spslam
