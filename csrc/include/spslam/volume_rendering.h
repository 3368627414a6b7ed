// Volume rendering of rays and the loss terms of tracking and mapping, with gradients (equations 5, 6, 8-11).
//
// R rays of S samples: sdf [R, S] normalized by the truncation distance, color [R, S, 3], t [R, S] depth in meters,
// valid [R, S] whether a sample lies inside the volume. All sums run in a fixed order.
#pragma once

#include <cstdint>

#include "core/device.h"

namespace spslam {

template <class T>
struct SampleTable {
  const T* sdf;
  const T* t;
  const bool* valid;
  std::int64_t num_rays, num_samples;
};

// out_color [R, 3], out_depth [R], weights [R, S] that sum to 1 along a ray, or to 0 where it meets nothing. Where
// out_color is null there is no color: depth and weights alone.
template <class Device, class T>
void volume_render(Device device, const SampleTable<T>& samples, const T* color, T truncation, T* out_color,
                   T* out_depth, T* weights);

// Gradients of the outputs, of which that of the weights may be null, to gradients of sdf, color and t. `weights` are
// those of the forward function. Where grad_out_color is null there is no color.
template <class Device, class T>
void volume_render_backward(Device device, const SampleTable<T>& samples, const T* color, const T* weights,
                            T truncation, const T* grad_out_color, const T* grad_out_depth, const T* grad_weights,
                            T* grad_sdf, T* grad_color, T* grad_t);

template <class T>
struct LossInputs {
  const T* color;         // [R, 3] rendered
  const T* depth;         // [R] rendered, m
  const bool* rendered;   // [R] whether the ray met anything
  const T* target_color;  // [R, 3]
  const T* target_depth;  // [R] m
  const T* cosine;        // [R] normal . direction, 0 = unknown
  T truncation;           // m
  bool cosine_targets;    // whether distances to the surface are scaled by `cosine`
};

// Partial sums of each loss term: a fixed number, so that the order of additions is fixed.
constexpr std::int64_t kLossPartials = 64;

// Elements of scratch memory that rendering_losses needs.
inline std::int64_t rendering_losses_workspace(std::int64_t num_rays) {
  return 4 * (num_rays + kLossPartials);
}

// losses [4]: rgb, depth, free space and SDF, each averaged over all R rays.
template <class Device, class T>
void rendering_losses(Device device, const SampleTable<T>& samples, const LossInputs<T>& inputs, T* losses,
                      T* workspace);

// grad_losses [4] to gradients of the rendered color and depth and of the samples' sdf and t.
template <class Device, class T>
void rendering_losses_backward(Device device, const SampleTable<T>& samples, const LossInputs<T>& inputs,
                               const T* grad_losses, T* grad_color, T* grad_depth, T* grad_sdf, T* grad_t);

}  // namespace spslam
