// The maths of Gauss-Newton tracking: one residual, the sums over them, and the step they give.
//
// A pixel's residual is the scene's SDF (m) at its back-projected surface point; the increment (dt, domega) moves the
// camera centre by dt and turns the camera by domega about it, from the left.
#pragma once

#include <cmath>
#include <cstdint>

#include "core/macros.h"
#include "core/vec.h"
#include "kernels/optimizer.h"
#include "kernels/pixel_record.h"

namespace spslam {

constexpr int kNormalTerms = 28;                  // 21 of the hessian, 6 of the gradient, the cost
constexpr int kTrackingTerms = kNormalTerms + 2;  // and the sum of weights and the number of inliers
// Beyond this the decoder's tanh is saturated and its slope says nothing about where the surface is.
constexpr float kSaturatedSdf = 0.98f;
constexpr float kMaxTrackingStep = 0.15f;  // norm of (dt in m, domega in rad)

struct SurfacePoint {
  Vec3<float> world;   // m
  Vec3<float> offset;  // world - camera centre
};

SPS_INLINE SurfacePoint surface_point(const Pixel& pixel, const Pose<float>& pose, float fx, float fy, float cx,
                                      float cy) {
  const Vec3<float> offset = pose.rotation * (pixel.depth * pixel_ray(pixel, fx, fy, cx, cy));
  return {offset + pose.translation, offset};
}

// Adds an inlier's residual. sdf is normalised, gradient its derivative by the world point (1/m).
SPS_INLINE void add_tracking_residual(const Vec3<float>& offset, float sdf, const Vec3<float>& gradient,
                                      float truncation, float kernel, double* terms) {
  const float residual = sdf * truncation;
  const Vec3<float> g = truncation * gradient;
  const Vec3<float> torque = cross(offset, g);
  const float ratio = residual / kernel;
  const float root = 1.0f / (1.0f + ratio * ratio);
  const double jacobian[6] = {g.x, g.y, g.z, torque.x, torque.y, torque.z};
  const double weight = static_cast<double>(root * root);
  add_normal_terms<double>(jacobian, static_cast<double>(residual), weight, terms);
  terms[kNormalTerms] += weight;
  terms[kNormalTerms + 1] += 1.0;
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

// Weighted mean squared residual, m^2.
SPS_INLINE double tracking_cost(const double* terms) {
  const double weights = terms[kNormalTerms];
  return weights > 1e-6 ? terms[kNormalTerms - 1] / weights : 0.0;
}

// Solves the normal equations and moves the pose; writes the iteration's four statistics.
SPS_INLINE void tracking_step(const double* terms, double damping, std::int64_t num_pixels, float* pose, float* stats,
                              float* hessian) {
  double h[36], g[6], cost, delta[6];
  store_normal_terms<double>(terms, h, g, &cost);
  double trace = 0.0;
  for (int a = 0; a < 6; ++a) trace += h[a * 7];
  // The absolute part keeps directions that no pixel sees from moving.
  solve_damped_6x6<double>(h, g, damping, 1e-6 * trace + 1e-8, 1e-12, delta);
  double norm = 0.0;
  for (int a = 0; a < 6; ++a) norm += delta[a] * delta[a];
  norm = std::sqrt(norm);
  const double scale = norm > kMaxTrackingStep ? kMaxTrackingStep / norm : 1.0;
  const Vec3<float> dt{static_cast<float>(scale * delta[0]), static_cast<float>(scale * delta[1]),
                       static_cast<float>(scale * delta[2])};
  const Vec3<float> domega{static_cast<float>(scale * delta[3]), static_cast<float>(scale * delta[4]),
                           static_cast<float>(scale * delta[5])};
  const Quaternion<float> q =
      normalized(quaternion_exp(domega) * Quaternion<float>{pose[0], pose[1], pose[2], pose[3]});
  pose[0] = q.w, pose[1] = q.x, pose[2] = q.y, pose[3] = q.z;
  pose[4] += dt.x, pose[5] += dt.y, pose[6] += dt.z;
  stats[0] = static_cast<float>(tracking_cost(terms));
  stats[1] = static_cast<float>(terms[kNormalTerms + 1] / static_cast<double>(num_pixels));
  stats[2] = std::sqrt(dot(dt, dt));
  stats[3] = std::sqrt(dot(domega, domega));
  for (int i = 0; i < 36; ++i) hessian[i] = static_cast<float>(h[i]);
}

}  // namespace spslam
