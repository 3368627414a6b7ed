// The plane that a depth image measured around a pixel: a least-squares fit of inverse depth, which is linear in the
// image where the surface is flat, over the 5x5 pixels around it that lie on the same surface. Without branches, so
// that a compiler can vectorize over pixels.
#pragma once

#include <cmath>
#include <cstdint>

#include "core/macros.h"
#include "core/math.h"
#include "core/vec.h"
#include "kernels/depth_noise.h"
#include "spslam/tsdf.h"

namespace spslam {

constexpr int kPlaneRadius = 2;
// A pixel whose inverse depth differs from the plane through the middle by more than this share, and by more than so
// many deviations of the noise, is of another surface.
constexpr float kPlaneGate = 0.015f, kPlaneGateDeviations = 4.0f;
// Steepest plane, as the tangent of the angle of incidence; what is steeper is an edge.
constexpr float kSteepest = 15.0f;
// Weight of the window's pixels that lie on the surface, as a share of the whole window's: with less, the pixel is of
// an edge or mixes two surfaces, and says nothing; from kFullSupport on depth is the plane's, in between it goes over
// from the pixel's own.
constexpr float kLeastSupport = 0.2f, kFullSupport = 0.5f;
// From this share on the weight does not grow any more.
constexpr float kFullWeightSupport = 0.67f;
// Cosine between ray and normal below which a measurement says nothing.
constexpr float kLeastCosine = 0.06f;
// Squared distance of the window's pixels from their plane, in variances of the noise, from which on they show the
// shape of the surface rather than noise, so that depth is the pixel's own.
constexpr float kShapeVariances = 2.0f;
// m: what surface and poses add to the noise of depth.
constexpr float kPoseVariance = 0.003f * 0.003f;
// px^2, a weak prior for a plane that faces the camera where the window is too narrow for a slope.
constexpr float kSlopePrior = 0.005f;

// Sums of weighted monomials over the window; q is the difference to the middle's inverse depth.
struct PlaneSums {
  float one, u, v, uu, uv, vv, q, qu, qv, qq;
};
constexpr int kPlaneSums = 10;

// The middle of a window: its inverse depth, one over the gate, and a first guess of the slopes, in gates per px.
struct PlaneMiddle {
  float q, by_u, by_v, inverse_gate;
};

// Of a pixel at an offset in the window.
SPS_INLINE constexpr float plane_window_weight(int du, int dv) {
  return 1.0f / (1.0f + 0.15f * static_cast<float>(du * du + dv * dv));
}

SPS_INLINE constexpr float whole_plane_window() {
  float whole = 0.0f;
  for (int dv = -kPlaneRadius; dv <= kPlaneRadius; ++dv) {
    for (int du = -kPlaneRadius; du <= kPlaneRadius; ++du) whole += plane_window_weight(du, dv);
  }
  return whole;
}

// The noise that differs from neighbor to neighbor, of which a fit has less.
SPS_INLINE DepthNoise own_noise(const PlaneNoise& noise) {
  return noise.is_shared ? DepthNoise{0.0f, 0.0f} : noise.depth;
}

// 1/m; where depth is unknown, a number that is beyond the gate around any other.
constexpr float kUnknownInverse = -1e15f;
SPS_INLINE float inverse_depth(float depth) {
  constexpr float kNearest = 1e-3f, kFarthest = 1e6f;
  return (depth > kNearest) & (depth < kFarthest) ? 1.0f / depth : kUnknownInverse;
}

// Slope along one axis: the smaller one of the differences to both neighbors, as an edge lies on one side at most.
SPS_INLINE float one_sided_slope(float before, float middle, float after) {
  const float backward = middle - before, forward = after - middle;
  const bool take_backward = (before > 0.0f) & ((after <= 0.0f) | (std::fabs(backward) < std::fabs(forward)));
  return take_backward ? backward : after > 0.0f ? forward : 0.0f;
}

SPS_INLINE PlaneMiddle plane_middle(const DepthNoise& own_noise, const Intrinsics& camera, float q, float by_u,
                                    float by_v) {
  const float safe = q > 0.0f ? q : 1.0f;
  const float deviation = std::sqrt(depth_variance(own_noise, 1.0f / safe)) * safe;
  const float wide = kPlaneGateDeviations * deviation;
  const float steepest_u = kSteepest / camera.fx * safe, steepest_v = kSteepest / camera.fy * safe;
  const bool surface_u = std::fabs(by_u) < steepest_u, surface_v = std::fabs(by_v) < steepest_v;
  const float inverse_gate = 1.0f / ((kPlaneGate + wide) * safe);
  return {q, surface_u ? by_u * inverse_gate : 0.0f, surface_v ? by_v * inverse_gate : 0.0f, inverse_gate};
}

// A pixel of the window: its weight, by Tukey's biweight of its distance from the plane through the middle, and the
// difference of its inverse depth to the middle's, times the weight, and times its square.
struct PlaneSample {
  float one, q, qq;
};

SPS_INLINE PlaneSample plane_sample(float q, const PlaneMiddle& middle, int du, int dv) {
  const float difference = q - middle.q;
  const float slope = middle.by_u * static_cast<float>(du) + middle.by_v * static_cast<float>(dv);
  const float share = difference * middle.inverse_gate - slope;
  const float closeness = larger(1.0f - share * share, 0.0f);
  const float weight = closeness * closeness * plane_window_weight(du, dv);
  return {weight, weight * difference, weight * difference * difference};
}

// Adds the row of a window that lies `dv` pixels below its middle: the pixels at u - 2 to u + 2. Pairs on both sides of
// the middle have the same factors.
SPS_INLINE void add_plane_row(const PlaneMiddle& middle, int dv, float q_left2, float q_left, float q_own,
                              float q_right, float q_right2, PlaneSums& sums) {
  static_assert(kPlaneRadius == 2, "the window's columns are written out");
  const PlaneSample own = plane_sample(q_own, middle, 0, dv);
  const PlaneSample left = plane_sample(q_left, middle, -1, dv), right = plane_sample(q_right, middle, 1, dv);
  const PlaneSample left2 = plane_sample(q_left2, middle, -2, dv), right2 = plane_sample(q_right2, middle, 2, dv);
  const float near = right.one + left.one, far = right2.one + left2.one;
  const float one = own.one + (near + far);
  const float u = (right.one - left.one) + 2.0f * (right2.one - left2.one);
  const float q = own.q + ((right.q + left.q) + (right2.q + left2.q));
  const float v = static_cast<float>(dv);
  sums.one += one;
  sums.u += u;
  sums.v += v * one;
  sums.uu += near + 4.0f * far;
  sums.uv += v * u;
  sums.vv += v * v * one;
  sums.q += q;
  sums.qu += (right.q - left.q) + 2.0f * (right2.q - left2.q);
  sums.qv += v * q;
  sums.qq += own.qq + ((right.qq + left.qq) + (right2.qq + left2.qq));
}

// How much a plane at a depth (m) counts, of 1 without noise.
SPS_INLINE float plane_certainty(const DepthNoise& noise, float depth) {
  return kPoseVariance / (kPoseVariance + depth_variance(noise, depth));
}

struct MeasuredPlane {
  Vec3<float> normal;
  float distance, weight;
};

// The plane of a pixel (u, v) from its window's sums; all 0 where there is none. `own_noise` is that of `noise` which
// differs from neighbor to neighbor.
SPS_INLINE MeasuredPlane fit_plane(const PlaneSums& s, const Intrinsics& camera, const DepthNoise& noise,
                                   const DepthNoise& own_noise, float u, float v, float center) {
  constexpr float kInverseWindow = 1.0f / whole_plane_window();
  const float scale = s.one > 0.0f ? 1.0f / s.one : 0.0f;
  const float mu = s.u * scale, mv = s.v * scale, mq = s.q * scale;
  const float uu = s.uu * scale - mu * mu + kSlopePrior, vv = s.vv * scale - mv * mv + kSlopePrior;
  const float uv = s.uv * scale - mu * mv, qu = s.qu * scale - mq * mu, qv = s.qv * scale - mq * mv;
  const float inverse_determinant = 1.0f / (uu * vv - uv * uv);
  const float by_u = (qu * vv - qv * uv) * inverse_determinant, by_v = (qv * uu - qu * uv) * inverse_determinant;
  const float support = s.one * kInverseWindow;
  const float over = (support - kLeastSupport) * (1.0f / (kFullSupport - kLeastSupport));
  // How far the window is from flat, and the pixel from the plane, in variances of inverse depth.
  const float safe = center > 0.0f ? center : 1.0f;
  const float noise_variance = depth_variance(own_noise, 1.0f / safe) * (safe * safe) * (safe * safe);
  const float moved = mq - by_u * mu - by_v * mv;
  const float spread = s.qq * scale - mq * mq - by_u * qu - by_v * qv;
  const float own = 0.5f * moved * moved;
  const float shape = (spread > own ? spread : own) / (kShapeVariances * noise_variance + 1e-20f);
  const float flat = 1.0f / (1.0f + shape * shape);
  const float share = (over < 0.0f ? 0.0f : over < 1.0f ? over : 1.0f) * flat;
  const float q = center + share * moved;
  // The plane is m . x = 1 in camera axes.
  const float inverse_fx = 1.0f / camera.fx, inverse_fy = 1.0f / camera.fy;
  const float x = (u - camera.cx) * inverse_fx, y = (v - camera.cy) * inverse_fy;
  const float mx = by_u * camera.fx, my = by_v * camera.fy, mz = q - mx * x - my * y;
  const float ray = std::sqrt(x * x + y * y + 1.0f);
  const float inverse = 1.0f / (std::sqrt(mx * mx + my * my + mz * mz) * ray);
  const float distance = inverse * ray, cosine = q * inverse;
  const bool known = (center > 0.0f) & (q > 0.0f) & (support > kLeastSupport) & (cosine > kLeastCosine);
  const float certainty = plane_certainty(noise, 1.0f / (known ? q : 1.0f));
  const float body = support * (1.0f / kFullWeightSupport);
  const float weight = certainty * cosine * (body < 1.0f ? body : 1.0f);
  return {{known ? mx * distance : 0.0f, known ? my * distance : 0.0f, known ? mz * distance : 0.0f},
          known ? distance : 0.0f,
          known ? weight : 0.0f};
}

SPS_INLINE MeasuredPlane load_plane(const float* in) {
  return {{in[0], in[1], in[2]}, in[3], in[4]};
}

SPS_INLINE void store_plane(const MeasuredPlane& plane, float* out) {
  out[0] = plane.normal.x;
  out[1] = plane.normal.y;
  out[2] = plane.normal.z;
  out[3] = plane.distance;
  out[4] = plane.weight;
}

}  // namespace spslam
