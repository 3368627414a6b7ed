// Depths of the samples along one ray (section III-B).
#pragma once

#include <cstdint>
#include <limits>

#include "core/macros.h"
#include "core/philox.h"
#include "spslam/types/ray_sampling.h"

namespace spslam {

// Random numbers drawn at a time on the host: full vectors, whatever the number of samples.
constexpr std::int32_t kDrawLanes = 16;

// Depth of uniform sample i, drawn with u in [0, 1). Ascending in i.
template <class T>
SPS_INLINE T uniform_depth(const RaySampling<T>& sampling, T depth, std::int32_t i, T u) {
  const T share = (static_cast<T>(i) + u) / static_cast<T>(sampling.num_uniform);
  return depth * (sampling.near + (sampling.far - sampling.near) * share);
}

// Depth of surface sample j, drawn with u in [0, 1). Ascending in j.
template <class T>
SPS_INLINE T surface_depth(const RaySampling<T>& sampling, T depth, std::int32_t j, T u) {
  const T share = (static_cast<T>(j) + u) / static_cast<T>(sampling.num_surface);
  return depth + sampling.truncation * (2 * share - 1);
}

// Depth of sample s: the uniform ones come first.
template <class T>
SPS_INLINE T sample_depth(const RaySampling<T>& sampling, T depth, std::int32_t s, T u) {
  return s < sampling.num_uniform ? uniform_depth(sampling, depth, s, u)
                                  : surface_depth(sampling, depth, s - sampling.num_uniform, u);
}

// The uniform number of sample s of a ray: counter element ray * S + s.
template <class T>
SPS_INLINE float sample_uniform(const PhiloxKey& key, const RaySampling<T>& sampling, std::int64_t ray,
                                std::int32_t s) {
  return philox_uniform(key, static_cast<std::uint32_t>(ray * sampling.num_samples() + s));
}

template <class T>
SPS_INLINE bool has_depth(T depth) {
  return depth > 0 && depth < std::numeric_limits<T>::infinity();
}

// Merges two ascending runs into `out`; of equal values those of `a` come first. The place of a value is its
// rank, found by counting: no branch depends on the values. `counts` has room for count_a.
template <class T>
SPS_INLINE void merge_ascending(const T* a, std::int32_t count_a, const T* b, std::int32_t count_b, T* counts, T* out) {
  for (std::int32_t i = 0; i < count_a; ++i) counts[i] = 0;
  for (std::int32_t j = 0; j < count_b; ++j) {
    T rank = 0;
    const T value = b[j];
    SPS_SIMD_SUM(rank)
    for (std::int32_t i = 0; i < count_a; ++i) {
      const T before = a[i] <= value ? T(1) : T(0);
      rank += before;
      counts[i] += 1 - before;
    }
    out[j + static_cast<std::int32_t>(rank)] = value;
  }
  for (std::int32_t i = 0; i < count_a; ++i) out[i + static_cast<std::int32_t>(counts[i])] = a[i];
}

// Elements of scratch that sample_ray needs.
template <class T>
SPS_INLINE std::int32_t sample_ray_scratch(const RaySampling<T>& sampling) {
  return 2 * sampling.num_samples() + kDrawLanes;
}

// All depths of one ray, ascending; zeros where there is no depth.
template <class T>
SPS_INLINE void sample_ray(const PhiloxKey& key, const RaySampling<T>& sampling, std::int64_t ray, T depth, T* scratch,
                           T* out) {
  const std::int32_t uniform = sampling.num_uniform, surface = sampling.num_surface, count = uniform + surface;
  if (!has_depth(depth)) {
    for (std::int32_t s = 0; s < count; ++s) out[s] = 0;
    return;
  }
  for (std::int32_t first = 0; first < count; first += kDrawLanes) {
    SPS_SIMD
    for (std::int32_t lane = 0; lane < kDrawLanes; ++lane) {
      scratch[first + lane] = static_cast<T>(sample_uniform(key, sampling, ray, first + lane));
    }
  }
  T* const near_surface = scratch + uniform;
  SPS_SIMD
  for (std::int32_t i = 0; i < uniform; ++i) scratch[i] = uniform_depth(sampling, depth, i, scratch[i]);
  SPS_SIMD
  for (std::int32_t j = 0; j < surface; ++j) near_surface[j] = surface_depth(sampling, depth, j, near_surface[j]);
  merge_ascending(scratch, uniform, near_surface, surface, near_surface + surface, out);
}

// The same without scratch memory, drawing while it merges.
template <class T>
SPS_INLINE void sample_ray(const PhiloxKey& key, const RaySampling<T>& sampling, std::int64_t ray, T depth, T* out) {
  const std::int32_t count = sampling.num_samples();
  if (!has_depth(depth)) {
    for (std::int32_t s = 0; s < count; ++s) out[s] = 0;
    return;
  }
  const auto draw = [&](std::int32_t s) {
    return s < count ? sample_depth(sampling, depth, s, static_cast<T>(sample_uniform(key, sampling, ray, s))) : T(0);
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
