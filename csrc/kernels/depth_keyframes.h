// The maths of aligning a frame with earlier frames' depth images: how far a surface point lies from what was seen
// there.
#pragma once

#include <cmath>
#include <cstdint>

#include "core/macros.h"
#include "core/vec.h"
#include "kernels/earlier_frame.h"
#include "kernels/gauss_newton.h"
#include "spslam/gauss_newton.h"

namespace spslam {

// And the sum of weights; of pairs where the map is known too, the map's weighted squares and sum of weights. The
// cost's place holds the weighted squares of such pairs.
constexpr int kKeyframeTerms = kNormalTerms + 3;
// Four pixels whose inverse depths spread more than this share have an edge between them.
constexpr float kMaxInverseDepthSpread = 0.03f;
// The map weighs this much at least and at most, against one view's pixel.
constexpr double kMinMapShare = 1e-3, kMaxMapShare = 4.0;

// Of the map and, after them, of the views.
constexpr int kJointTerms = kTrackingTerms + kKeyframeTerms;

// An earlier frame with its pose read.
struct DepthKeyframe {
  const std::uint16_t* image;
  Pose<float> pose;
};

SPS_INLINE DepthKeyframe load_depth_keyframe(const DepthKeyframes& views, int k) {
  return {views.images + views.image_rows[k] * views.height * views.width,
          load_pose(views.poses + kPoseSize * views.pose_rows[k])};
}

// The map's residual (m) at a pixel, where the map knows the surface.
struct MapResidual {
  float value;
  bool known;
};

// Adds a world point's signed distance (m) from the surface that an earlier frame saw, beyond it positive, to terms of
// type T; nothing where the point falls off the image or between pixels that have no depth or an edge. The inverse
// depth q of a plane is linear in the image, so z q(u, v) - 1 is linear in the point, and by its slope a distance.
template <class T>
SPS_INLINE void add_depth_keyframe_residual(const DepthKeyframes& views, const DepthKeyframe& view,
                                            const Vec3<float>& world, const Vec3<float>& offset, float kernel,
                                            float certainty, const MapResidual& map, T* terms) {
  const FramePlace place = place_in_frame(view.pose, views.intrinsics, views.height, views.width, world);
  if (!place.inside) return;
  const std::uint16_t* row = view.image + place.row * views.width + place.column;
  const std::uint16_t d00 = row[0], d01 = row[1], d10 = row[views.width], d11 = row[views.width + 1];
  if (d00 == 0 || d01 == 0 || d10 == 0 || d11 == 0) return;
  const float q00 = 1.0f / (views.unit * d00), q01 = 1.0f / (views.unit * d01);
  const float q10 = 1.0f / (views.unit * d10), q11 = 1.0f / (views.unit * d11);
  const float most = std::fmax(std::fmax(q00, q01), std::fmax(q10, q11));
  const float least = std::fmin(std::fmin(q00, q01), std::fmin(q10, q11));
  if (!(most - least < kMaxInverseDepthSpread * most)) return;
  const BilinearValue q = bilinear_value(q00, q01, q10, q11, place.a, place.b);
  const float x = q.by_u * views.intrinsics.fx, y = q.by_v * views.intrinsics.fy;
  const Vec3<float> gradient{x, y, q.value - (x * place.seen.x + y * place.seen.y) * place.inverse_z};
  const float inverse_slope = 1.0f / std::fmax(std::sqrt(dot(gradient, gradient)), 1e-6f);
  const float residual = (place.seen.z * q.value - 1.0f) * inverse_slope;
  const T weight = static_cast<T>(certainty) * static_cast<T>(robust_weight(residual, kernel));
  add_weighted_residual(offset, residual, view.pose.rotation * (inverse_slope * gradient), weight, terms);
  if (!map.known) return;
  const T of_map = static_cast<T>(certainty) * static_cast<T>(robust_weight(map.value, kernel));
  const T squared = static_cast<T>(residual) * static_cast<T>(residual);
  terms[kNormalTerms - 1] += weight * squared;
  terms[kNormalTerms] += weight;
  terms[kNormalTerms + 1] += of_map * static_cast<T>(map.value) * static_cast<T>(map.value);
  terms[kNormalTerms + 2] += of_map;
}

// What the map's equations count against the mean of the views': the square of the ratio of variances, as the map's
// error, unlike a sensor's noise, is alike for neighboring pixels and does not average out. 1 without common pixels.
SPS_INLINE double map_share(const double* views) {
  const double of_views = views[kNormalTerms], of_map = views[kNormalTerms + 2];
  if (!(of_views > 1e-6 && of_map > 1e-6)) return 1.0;
  const double ratio = views[kNormalTerms - 1] / of_views / (views[kNormalTerms + 1] / of_map + 1e-12);
  const double share = ratio * ratio;
  return share < kMinMapShare ? kMinMapShare : share < kMaxMapShare ? share : kMaxMapShare;
}

// The equations that the step is solved from: those of the map times its share, and the mean of the views'.
SPS_INLINE void join_keyframe_terms(const double* map, const double* views, int count, double* joint) {
  const double share = count > 0 ? map_share(views) : 1.0, of_view = count > 0 ? 1.0 / count : 0.0;
  for (int t = 0; t < kNormalTerms; ++t) joint[t] = count > 0 ? share * map[t] + of_view * views[t] : map[t];
}

}  // namespace spslam
