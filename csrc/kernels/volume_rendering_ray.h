// Rendering and losses of one whole ray, forward and backward, over the sample functions of volume_rendering.h.
#pragma once

#include "kernels/ray_sampling.h"
#include "kernels/volume_rendering.h"

namespace spslam {

// Mask is bool, or T on the host: a loop over bytes and floats needs four times as many lanes, more than a ray has
// samples.
template <class T, class Mask>
struct RaySamples {
  const T* sdf;       // normalized
  const T* t;         // depth, m
  const Mask* valid;  // inside the volume
  std::int32_t count;
};

template <class T, class Mask>
SPS_INLINE T first_crossing(const RaySamples<T, Mask>& ray) {
  T first = std::numeric_limits<T>::infinity();
  SPS_SIMD_MIN(first)
  for (std::int32_t i = 0; i < ray.count; ++i) {
    const T depth = crossing_depth(ray.sdf[i], ray.t[i], ray.valid[i] != 0);
    first = depth < first ? depth : first;
  }
  return first;
}

// Color [3], depth and normalized weights of a ray (5, 6). `color` is [S, 3]. With kColored false there is no color.
template <bool kColored = true, class T, class Mask>
SPS_INLINE void render_ray(const RaySamples<T, Mask>& ray, const T* color, T truncation, T* out_color, T* out_depth,
                           T* weights) {
  const T first = first_crossing(ray), inverse_truncation = 1 / truncation;
  T sum = 0;
  SPS_SIMD_SUM(sum)
  for (std::int32_t i = 0; i < ray.count; ++i) {
    const bool visible = sample_visible(ray.t[i], ray.valid[i] != 0, first, truncation);
    const T value = bell(ray.sdf[i], inverse_truncation).value;
    weights[i] = visible ? value : T(0);
    sum += weights[i];
  }
  const T scale = inverse_weight_sum(sum);
  T red = 0, green = 0, blue = 0, depth = 0;
  SPS_SIMD_SUM(red, green, blue, depth)
  for (std::int32_t i = 0; i < ray.count; ++i) {
    const T weight = weights[i] * scale;
    weights[i] = weight;
    if constexpr (kColored) {
      red += weight * color[3 * i];
      green += weight * color[3 * i + 1];
      blue += weight * color[3 * i + 2];
    }
    depth += weight * ray.t[i];
  }
  if constexpr (kColored) {
    out_color[0] = red;
    out_color[1] = green;
    out_color[2] = blue;
  }
  *out_depth = depth;
}

// Gradients of a ray's outputs. `weights` [S] may be null: zero.
template <class T>
struct RenderGradient {
  const T* color;  // [3]
  T depth;
  const T* weights;

  // d L / d weight of a sample.
  template <bool kColored>
  SPS_INLINE T of_weight(std::int32_t i, const T* sample_color, T t) const {
    if constexpr (!kColored) return depth * t + (weights ? weights[i] : T(0));
    const T* c = sample_color + 3 * i;
    return color[0] * c[0] + color[1] * c[1] + color[2] * c[2] + depth * t + (weights ? weights[i] : T(0));
  }
};

// `weights` are those that render_ray returned.
template <bool kColored = true, class T, class Mask>
SPS_INLINE void render_ray_backward(const RaySamples<T, Mask>& ray, const T* color, const T* weights, T truncation,
                                    const RenderGradient<T>& grad, T* grad_sdf, T* grad_color, T* grad_t) {
  const T first = first_crossing(ray), inverse_truncation = 1 / truncation;
  T sum = 0, mean = 0;
  T* const slopes = grad_sdf;  // replaced by the gradient below
  SPS_SIMD_SUM(sum, mean)
  for (std::int32_t i = 0; i < ray.count; ++i) {
    const bool visible = sample_visible(ray.t[i], ray.valid[i] != 0, first, truncation);
    const Bell<T> b = bell(ray.sdf[i], inverse_truncation);
    sum += visible ? b.value : T(0);
    slopes[i] = visible ? b.slope : T(0);
    mean += weights[i] * grad.template of_weight<kColored>(i, color, ray.t[i]);
  }
  const T scale = inverse_weight_sum(sum);
  SPS_SIMD
  for (std::int32_t i = 0; i < ray.count; ++i) {
    grad_sdf[i] = weight_backward(grad.template of_weight<kColored>(i, color, ray.t[i]), mean, slopes[i], scale);
    grad_t[i] = weights[i] * grad.depth;
    if constexpr (kColored) {
      grad_color[3 * i] = weights[i] * grad.color[0];
      grad_color[3 * i + 1] = weights[i] * grad.color[1];
      grad_color[3 * i + 2] = weights[i] * grad.color[2];
    }
  }
}

// What a ray measured, and whether it met anything when rendered.
template <class T>
struct RayTarget {
  const T* color;  // [3]
  T depth;         // m; the ray is left out where it is not positive and finite
  T cosine;        // target_cosine of the ray
  bool rendered;
};

// The four terms of a ray: rgb, depth, free space, SDF (8-11).
template <class T, class Mask>
SPS_INLINE void ray_losses(const RaySamples<T, Mask>& ray, const T* color, T depth, const RayTarget<T>& target,
                           T truncation, T* terms) {
  for (int k = 0; k < 4; ++k) terms[k] = 0;
  if (!has_depth(target.depth)) return;
  T near = 0, free = 0, near_sum = 0, free_sum = 0;
  SPS_SIMD_SUM(near, free, near_sum, free_sum)
  for (std::int32_t i = 0; i < ray.count; ++i) {
    const T distance = target_distance(target.depth, ray.t[i], target.cosine);
    const bool valid = ray.valid[i] != 0;
    const T near_residual = sdf_residual(ray.sdf[i], distance, truncation);
    const T free_residual = free_space_residual(ray.sdf[i]);
    near += near_surface(distance, truncation, valid) ? T(1) : T(0);
    free += in_free_space(distance, truncation) ? T(1) : T(0);
    near_sum += near_surface(distance, truncation, valid) ? near_residual * near_residual : T(0);
    free_sum += valid & in_free_space(distance, truncation) ? free_residual * free_residual : T(0);
  }
  terms[0] = target.rendered ? color_loss(color, target.color) : T(0);
  terms[1] = target.rendered ? depth_loss(depth, target.depth) : T(0);
  terms[2] = free_sum * inverse_count(free);
  terms[3] = near_sum * inverse_count(near);
}

// grad [4] holds d L / d term. Outputs are overwritten.
template <class T, class Mask>
SPS_INLINE void ray_losses_backward(const RaySamples<T, Mask>& ray, const T* color, T depth, const RayTarget<T>& target,
                                    T truncation, const T* grad, T* grad_color, T* grad_depth, T* grad_sdf, T* grad_t) {
  const bool measured = has_depth(target.depth), rendered = measured && target.rendered;
  for (int c = 0; c < 3; ++c) {
    grad_color[c] = rendered ? grad[0] * color_loss_gradient(color[c], target.color[c]) : T(0);
  }
  *grad_depth = rendered ? grad[1] * depth_loss_gradient(depth, target.depth) : T(0);
  if (!measured) {
    for (std::int32_t i = 0; i < ray.count; ++i) grad_sdf[i] = grad_t[i] = 0;
    return;
  }

  T near = 0, free = 0;
  SPS_SIMD_SUM(near, free)
  for (std::int32_t i = 0; i < ray.count; ++i) {
    const T distance = target_distance(target.depth, ray.t[i], target.cosine);
    const bool valid = ray.valid[i] != 0;
    near += near_surface(distance, truncation, valid) ? T(1) : T(0);
    free += in_free_space(distance, truncation) ? T(1) : T(0);
  }
  const T free_scale = 2 * grad[2] * inverse_count(free), near_scale = 2 * grad[3] * inverse_count(near);
  SPS_SIMD
  for (std::int32_t i = 0; i < ray.count; ++i) {
    const T distance = target_distance(target.depth, ray.t[i], target.cosine);
    const bool valid = ray.valid[i] != 0;
    const T near_gradient = near_scale * sdf_residual(ray.sdf[i], distance, truncation);
    const T free_gradient = free_scale * free_space_residual(ray.sdf[i]);
    const T near_part = near_surface(distance, truncation, valid) ? near_gradient : T(0);
    const T free_part = valid & in_free_space(distance, truncation) ? free_gradient : T(0);
    grad_sdf[i] = near_part * truncation + free_part;
    grad_t[i] = near_part * target.cosine;
  }
}

}  // namespace spslam
