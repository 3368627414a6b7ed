// Robust residuals of a camera pose: their weights, and the sums over them that tracking is solved from.
//
// A residual is in meters; the increment (dt, domega) moves the camera center by dt and turns the camera by domega
// about it, from the left.
#pragma once

#include "core/macros.h"
#include "core/vec.h"
#include "kernels/optimizer.h"

namespace spslam {

// After the normal equations: the sum of score weights, the number of inliers, the sum of the equations' weights. The
// cost is that of the score weights.
constexpr int kTrackingTerms = kNormalTerms + 3;

// Of the frame's log gain, beside normal equations of its pose: by pose and gain, by the gain alone, its gradient.
constexpr int kGainTerms = 8;

// Widths (m) of the robust kernel.
struct KernelWidths {
  float step;      // of the weights that move the pose
  float score;     // of the weights that say how well it fits
  float keyframe;  // of residuals against depth keyframes
};

// Weight of a residual by Geman and McClure: 1 / (1 + (r / kernel)^2)^2.
SPS_INLINE float robust_weight(float residual, float kernel) {
  const float ratio = residual / kernel;
  const float root = 1.0f / (1.0f + ratio * ratio);
  return root * root;
}

// Adds a residual (m) of a weight to the hessian and gradient in sums of type T, and nothing to the cost. slope is its
// derivative by the surface point, offset the point seen from the camera center that the increment turns about.
template <class T>
SPS_INLINE void add_weighted_residual(const Vec3<float>& offset, float residual, const Vec3<float>& slope, T weight,
                                      T* terms) {
  const Vec3<float> by_rotation = cross(offset, slope);
  const T jacobian[6] = {slope.x, slope.y, slope.z, by_rotation.x, by_rotation.y, by_rotation.z};
  const T cost = terms[kNormalTerms - 1];
  add_normal_terms<T>(jacobian, static_cast<T>(residual), weight, terms);
  terms[kNormalTerms - 1] = cost;
}

// Adds what a residual's derivative by the frame's log gain, `by_gain`, adds to `gain_terms`; the rest is as of
// `add_weighted_residual`.
template <class T>
SPS_INLINE void add_gain_residual(const Vec3<float>& offset, float residual, const Vec3<float>& slope, float by_gain,
                                  T weight, T* gain_terms) {
  const Vec3<float> by_rotation = cross(offset, slope);
  const T row[kGainTerms] = {slope.x, slope.y, slope.z, by_rotation.x, by_rotation.y, by_rotation.z, by_gain, residual};
  const T scaled = weight * static_cast<T>(by_gain);
  for (int t = 0; t < kGainTerms; ++t) gain_terms[t] += scaled * row[t];
}

// Adds a residual (m) with its robust weight times `certainty`. The measures of fit, cost and sum of weights, use the
// score width and no certainty.
template <class T>
SPS_INLINE void add_robust_residual(const Vec3<float>& offset, float residual, const Vec3<float>& slope,
                                    const KernelWidths& kernel, float certainty, T* terms) {
  const T weight = static_cast<T>(certainty) * static_cast<T>(robust_weight(residual, kernel.step));
  const T score = static_cast<T>(robust_weight(residual, kernel.score)), r = static_cast<T>(residual);
  add_weighted_residual(offset, residual, slope, weight, terms);
  terms[kNormalTerms - 1] += score * r * r;
  terms[kNormalTerms] += score;
  terms[kNormalTerms + 1] += T(1);
  terms[kNormalTerms + 2] += weight;
}

}  // namespace spslam
