// The maths of Gauss-Newton tracking: one residual, the sums over them, and the step they give.
//
// A pixel's residual is the scene's SDF (m) at its back-projected surface point; the increment (dt, domega) moves the
// camera center by dt and turns the camera by domega about it, from the left.
#pragma once

#include <cmath>
#include <cstdint>

#include "core/macros.h"
#include "core/vec.h"
#include "kernels/optimizer.h"
#include "kernels/pixel_record.h"
#include "spslam/gauss_newton.h"

namespace spslam {

// And the sum of judging weights, the number of inliers, the sum of weights times certainties.
constexpr int kTrackingTerms = kNormalTerms + 3;
// Beyond this the decoder's tanh is saturated and its slope says nothing about where the surface is.
constexpr float kSaturatedSdf = 0.98f;
constexpr float kMaxTrackingStep = 0.15f;  // norm of (dt in m, domega in rad)

// Widths (m) of the robust kernel: of the weights that move the pose, and of those that tell how well it fits.
struct KernelWidths {
  float step, judge;
  float view;  // of earlier frames' depth images
};

struct SurfacePoint {
  Vec3<float> world;   // m
  Vec3<float> offset;  // world - camera center
};

SPS_INLINE SurfacePoint surface_point(const Pixel& pixel, const Pose<float>& pose, float fx, float fy, float cx,
                                      float cy) {
  const Vec3<float> offset = pose.rotation * (pixel.depth * pixel_ray(pixel, fx, fy, cx, cy));
  return {offset + pose.translation, offset};
}

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
  const Vec3<float> torque = cross(offset, slope);
  const T jacobian[6] = {slope.x, slope.y, slope.z, torque.x, torque.y, torque.z};
  const T cost = terms[kNormalTerms - 1];
  add_normal_terms<T>(jacobian, static_cast<T>(residual), weight, terms);
  terms[kNormalTerms - 1] = cost;
}

// Adds a residual (m) of its robust weight times `certainty`. How well the pose fits, the cost and the sum of weights,
// is told by the judging width and without the certainty.
template <class T>
SPS_INLINE void add_robust_residual(const Vec3<float>& offset, float residual, const Vec3<float>& slope,
                                    const KernelWidths& kernel, float certainty, T* terms) {
  const T weight = static_cast<T>(certainty) * static_cast<T>(robust_weight(residual, kernel.step));
  const T judged = static_cast<T>(robust_weight(residual, kernel.judge)), r = static_cast<T>(residual);
  add_weighted_residual(offset, residual, slope, weight, terms);
  terms[kNormalTerms - 1] += judged * r * r;
  terms[kNormalTerms] += judged;
  terms[kNormalTerms + 1] += T(1);
  terms[kNormalTerms + 2] += weight;
}

// The same of an inlier's SDF, which is normalized, and its gradient by the world point (1/m).
template <class T>
SPS_INLINE void add_tracking_residual(const Vec3<float>& offset, float sdf, const Vec3<float>& gradient,
                                      float truncation, const KernelWidths& kernel, float certainty, T* terms) {
  add_robust_residual(offset, sdf * truncation, truncation * gradient, kernel, certainty, terms);
}

// Inverse variance of a residual as a share of that at the camera: a structured-light or stereo depth's noise grows
// with z^2, and adds to that of the map.
SPS_INLINE float depth_certainty(float depth, float noise_crossover_depth) {
  if (!(noise_crossover_depth > 0.0f)) return 1.0f;
  const float ratio = depth / noise_crossover_depth, squared = ratio * ratio;
  return 1.0f / (1.0f + squared * squared);
}

SPS_INLINE bool is_tracking_inlier(float depth, bool inside, float sdf) {
  return depth > 0.0f && inside && std::fabs(sdf) < kSaturatedSdf;
}

// Width of the robust kernel in an iteration: geometric from start to end, which it reaches one iteration before the
// last.
SPS_INLINE float annealed_kernel(float start, float end, std::int64_t iteration, std::int64_t iterations) {
  const float steps = static_cast<float>(iterations > 2 ? iterations - 2 : 1);
  const float progress = static_cast<float>(iteration) / steps;
  return start * std::pow(end / start, progress < 1.0f ? progress : 1.0f);
}

// The widths in an iteration of tracking; what is judged by is that of the step where options name none.
SPS_INLINE KernelWidths tracking_kernel(const TrackingOptions& options, std::int64_t iteration) {
  const float step = annealed_kernel(options.kernel_start, options.kernel_end, iteration, options.iterations);
  const float view = options.views.count > 0 ? annealed_kernel(options.kernel_start, options.views.kernel_end,
                                                               iteration, options.iterations)
                                             : step;
  return {step, options.score_kernel > 0.0f ? options.score_kernel : step, view};
}

// How many views take part in an iteration.
SPS_INLINE int keyframes_in_use(const DepthKeyframes& views, std::int64_t iteration) {
  return iteration >= views.first_iteration ? views.count : 0;
}

// Weighted mean squared residual, m^2.
SPS_INLINE double tracking_cost(const double* terms) {
  const double weights = terms[kNormalTerms];
  return weights > 1e-6 ? terms[kNormalTerms - 1] / weights : 0.0;
}

// Solves the joint normal equations and moves the pose; steps gets |dt| (m) and |domega| (rad), hessian what the map's
// matrix would be if pixels weighed on average what they are judged by, without certainties, so that it tells how the
// pose is held and neither how far away the surface is nor how narrow the kernel.
SPS_INLINE void tracking_step(const double* terms, const double* joint, double damping, float* pose, float* steps,
                              float* hessian) {
  double h[36], g[6], cost, delta[6];
  store_normal_terms<double>(joint, h, g, &cost);
  double trace = 0.0;
  for (int a = 0; a < 6; ++a) trace += h[a * 7];
  // The absolute part keeps directions that no pixel sees from moving.
  solve_damped_6x6<double>(h, g, damping, 1e-6 * trace + 1e-8, 1e-12, delta);
  float step[6], norm = 0.0f;
  for (int a = 0; a < 6; ++a) step[a] = static_cast<float>(delta[a]), norm += step[a] * step[a];
  norm = std::sqrt(norm);
  const float scale = norm > kMaxTrackingStep ? kMaxTrackingStep / norm : 1.0f;
  const Vec3<float> dt{scale * step[0], scale * step[1], scale * step[2]};
  const Vec3<float> domega{scale * step[3], scale * step[4], scale * step[5]};
  const Quaternion<float> q =
      normalized(quaternion_exp(domega) * Quaternion<float>{pose[0], pose[1], pose[2], pose[3]});
  pose[0] = q.w, pose[1] = q.x, pose[2] = q.y, pose[3] = q.z;
  pose[4] += dt.x, pose[5] += dt.y, pose[6] += dt.z;
  steps[0] = std::sqrt(dot(dt, dt));
  steps[1] = std::sqrt(dot(domega, domega));
  const double certain = terms[kNormalTerms + 2], share = certain > 0.0 ? terms[kNormalTerms] / certain : 1.0;
  store_normal_terms<double>(terms, h, g, &cost);
  for (int i = 0; i < 36; ++i) hessian[i] = static_cast<float>(share * h[i]);
}

// What an iteration's sums say of the pose before its step; columns 0, 1 and 4 of its statistics.
SPS_INLINE void tracking_fit(const double* terms, std::int64_t num_pixels, float* stats) {
  const double count = static_cast<double>(num_pixels > 0 ? num_pixels : 1);
  stats[0] = static_cast<float>(tracking_cost(terms));
  stats[1] = static_cast<float>(terms[kNormalTerms + 1] / count);
  stats[4] = static_cast<float>(terms[kNormalTerms] / count);
}

// The pose after `before` and `last` if the camera goes on as it went, T1 T0^-1 T1, its w not negative.
SPS_INLINE void constant_speed_pose(const float* before, const float* last, float* next) {
  const Quaternion<double> q0 = normalized(Quaternion<double>{before[0], before[1], before[2], before[3]});
  const Quaternion<double> q1 = normalized(Quaternion<double>{last[0], last[1], last[2], last[3]});
  const Quaternion<double> turn = q1 * Quaternion<double>{q0.w, -q0.x, -q0.y, -q0.z};
  const Quaternion<double> q = normalized(turn * q1);
  const Vec3<double> t0{before[4], before[5], before[6]}, t1{last[4], last[5], last[6]};
  const Vec3<double> t = rotation(turn) * (t1 - t0) + t1;
  const double sign = q.w < 0.0 ? -1.0 : 1.0;
  const double pose[7] = {sign * q.w, sign * q.x, sign * q.y, sign * q.z, t.x, t.y, t.z};
  for (int i = 0; i < 7; ++i) next[i] = static_cast<float>(pose[i]);
}

}  // namespace spslam
