// Rendering weights of the samples of one ray and the loss terms of a ray (equations 5, 6, 8-11), with derivatives.
// `sdf` is normalized: the signed distance divided by the truncation distance, in [-1, 1].
#pragma once

#include <cmath>
#include <cstdint>
#include <limits>

#include "core/macros.h"
#include "core/math.h"

namespace spslam {

// Weights before normalization (bells) below this are 0: samples that far from the surface are not rendered.
constexpr double kMinBell = 1e-3;
// Grazing rays: normal . direction is not taken below this.
constexpr double kMinCosine = 0.15;

// ---- weights (6)

template <class T>
struct Bell {
  T value;
  T slope;  // d value / d sdf
};

// sigmoid(s / tr) * sigmoid(-s / tr), zero below the floor.
template <class T>
SPS_INLINE Bell<T> bell(T sdf, T inverse_truncation) {
  const T e = exponential(-std::fabs(sdf) * inverse_truncation);
  const T d = 1 / (1 + e);
  const T value = e * d * d;
  const T slope = inverse_truncation * value * (1 - e) * d;
  const bool cut = value < T(kMinBell);
  return {cut ? T(0) : value, cut ? T(0) : (sdf > 0 ? -slope : slope)};
}

// Depth of a sample if it lies behind a surface, infinity if not: the smallest along a ray is its first crossing.
template <class T>
SPS_INLINE T crossing_depth(T sdf, T t, bool valid) {
  return valid & (sdf < 0) ? t : std::numeric_limits<T>::infinity();
}

// Whether a sample takes part in rendering: inside the volume, and not deeper than the first crossing plus truncation.
template <class T>
SPS_INLINE bool sample_visible(T t, bool valid, T first_crossing, T truncation) {
  return valid & (t <= first_crossing + truncation);
}

// 1 / sum of the bells, by which weights are normalized; 0 for a ray that meets nothing.
template <class T>
SPS_INLINE T inverse_weight_sum(T bell_sum) {
  return bell_sum > 0 || bell_sum != bell_sum ? 1 / bell_sum : T(0);
}

// d L / d sdf of a sample, from d L / d its normalized weight, the ray's sum of weight * (d L / d weight), the slope of
// its bell (0 if it is not visible) and the inverse sum of bells.
template <class T>
SPS_INLINE T weight_backward(T grad_weight, T weighted_mean_grad, T bell_slope, T inverse_sum) {
  return (grad_weight - weighted_mean_grad) * bell_slope * inverse_sum;
}

// ---- losses (8-11)

// Scale from distance along the ray to distance to the surface: normal . direction where the direction has depth 1, so
// it may exceed 1 towards the image's corners; 0 where the normal is unknown.
template <class T>
SPS_INLINE T target_cosine(T cosine, bool cosine_targets) {
  return cosine_targets && cosine > 0 ? (cosine > T(kMinCosine) ? cosine : T(kMinCosine)) : T(1);
}

// Distance of a sample to the measured surface (m), positive in front of it.
template <class T>
SPS_INLINE T target_distance(T target_depth, T t, T cosine) {
  return (target_depth - t) * cosine;
}

// Whether the SDF term supervises a sample (10): within the truncation distance and inside the volume.
template <class T>
SPS_INLINE bool near_surface(T distance, T truncation, bool valid) {
  return valid & (std::fabs(distance) < truncation);
}

// Whether a sample counts for the free-space term (11): farther in front, inside the volume or not.
template <class T>
SPS_INLINE bool in_free_space(T distance, T truncation) {
  return distance >= truncation;
}

// The three above at once, for code that runs one sample at a time: a struct of flags prevents vectorization of a loop.
template <class T>
struct SampleTarget {
  T distance;
  bool near, free;
};

template <class T>
SPS_INLINE SampleTarget<T> sample_target(T target_depth, T t, T cosine, T truncation, bool valid) {
  const T distance = target_distance(target_depth, t, cosine);
  return {distance, near_surface(distance, truncation, valid), in_free_space(distance, truncation)};
}

// Residual of the SDF term in meters; its derivatives are truncation by sdf and cosine by t.
template <class T>
SPS_INLINE T sdf_residual(T sdf, T distance, T truncation) {
  return sdf * truncation - distance;
}

// Residual of the free-space term, normalized; its derivative by sdf is 1.
template <class T>
SPS_INLINE T free_space_residual(T sdf) {
  return sdf - 1;
}

// 1 / count, 0 for none: the mean over a ray's samples of one kind. Counted in T, which vectorizes better.
template <class T>
SPS_INLINE T inverse_count(T count) {
  return count > 0 ? 1 / count : T(0);
}

// The four terms of one ray, in the order of the public op.
template <class T>
struct RayLosses {
  T rgb, depth, free_space, sdf;
};

// What the samples of one ray are compared with on the SDF itself (10, 11).
template <class T>
struct SdfSupervision {
  T target_depth, cosine, truncation;
  T near_share, free_share;    // 1 / number of samples of the kind
  T near_weight, free_weight;  // of the terms
};

// Adds the SDF and free-space terms of a sample inside the volume to the ray's losses, without weights; returns their
// weighted gradient by the SDF.
template <class T>
SPS_INLINE T supervise_sample(const SdfSupervision<T>& ray, T sdf, T t, RayLosses<T>& losses) {
  const SampleTarget<T> target = sample_target(ray.target_depth, t, ray.cosine, ray.truncation, true);
  const T near = target.near ? sdf_residual(sdf, target.distance, ray.truncation) : T(0);
  const T free = target.free ? free_space_residual(sdf) : T(0);
  losses.sdf += ray.near_share * near * near;
  losses.free_space += ray.free_share * free * free;
  return 2 * (ray.near_weight * ray.near_share * ray.truncation * near + ray.free_weight * ray.free_share * free);
}

// Mean squared color error over the channels (8).
template <class T>
SPS_INLINE T color_loss(const T* color, const T* target) {
  T sum = 0;
  for (int c = 0; c < 3; ++c) sum += (color[c] - target[c]) * (color[c] - target[c]);
  return sum / 3;
}

template <class T>
SPS_INLINE T color_loss_gradient(T color, T target) {
  return 2 * (color - target) / 3;
}

// Squared depth error (9), m^2.
template <class T>
SPS_INLINE T depth_loss(T depth, T target) {
  return (depth - target) * (depth - target);
}

template <class T>
SPS_INLINE T depth_loss_gradient(T depth, T target) {
  return 2 * (depth - target);
}

}  // namespace spslam
