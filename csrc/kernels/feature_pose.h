// The maths of one image feature: its error at a pose, and what that wants of the pose.
#pragma once

#include <cmath>
#include <limits>

#include "core/macros.h"
#include "core/vec.h"
#include "kernels/optimizer.h"
#include "spslam/feature_pose.h"

namespace spslam {

constexpr double kMinFeatureDepth = 0.05;  // m before the camera, of what it can show
// Of what was seen without depth, by its expected inverse depth: what seems to lie beyond the range may be nearer.
constexpr double kInverseDepthDeviations = 4.0;
// Of a point's depth, by which it may be off, as an inlier's error is of its position.
constexpr double kDepthDeviations = 3.0;
constexpr double kWideErrors = 3.0;  // times the error of an inlier, the width of the robust kernel
// As many a frame's are worth: those of one earlier frame are off by the same.
constexpr double kIndependentFeatures = 50.0;

// What a camera shows: a point in its axes, which may be scaled, the inverse of its depth (1/m), where it is shown, and
// by how much that may be off beside, along the epipolar line (px).
struct ShownFeature {
  Vec3<double> point;
  double inverse_depth, u, v, along_u, along_v;
};

// An error (px), and what times the part of anything along the epipolar line is to be taken from it.
struct FeatureError {
  double u, v, unit_u, unit_v, less_u, less_v;

  SPS_INLINE double square() const { return u * u + v * v; }
};

// A feature whose point may have moved by `moved` (m): to first order its position moves along the epipolar line.
SPS_INLINE ShownFeature shown_feature(const FeatureCamera& k, const Vec3<double>& point, double inverse_depth,
                                      const double* position, const Vec3<double>& moved) {
  const double by_z = 1.0 / point.z;
  return {point,
          inverse_depth,
          position[0],
          position[1],
          k.fx * (moved.x - point.x * by_z * moved.z) * by_z,
          k.fy * (moved.y - point.y * by_z * moved.z) * by_z};
}

SPS_INLINE FeatureError feature_error(const FeatureCamera& k, const ShownFeature& shown, double error_px) {
  const double u = k.fx * shown.point.x / shown.point.z + k.cx - shown.u;
  const double v = k.fy * shown.point.y / shown.point.z + k.cy - shown.v;
  const double length = std::sqrt(shown.along_u * shown.along_u + shown.along_v * shown.along_v);
  const double by_length = 1.0 / (length > 0.0 ? length : std::numeric_limits<double>::min());
  const double unit_u = shown.along_u * by_length, unit_v = shown.along_v * by_length;
  const double less = 1.0 - error_px / std::sqrt(error_px * error_px + length * length);
  const double part = unit_u * u + unit_v * v;
  return {u - less * unit_u * part, v - less * unit_v * part, unit_u, unit_v, less * unit_u, less * unit_v};
}

// Adds what an error wants of a step in camera axes, by Geman-McClure's weight. With a = x/z and b = y/z, a point's
// derivatives are f_x (-1/z, 0, a/z, ab, -(1 + a^2), b) and f_y (0, -1/z, b/z, 1 + b^2, -ab, -a).
SPS_INLINE void add_feature(const FeatureCamera& k, const ShownFeature& shown, const FeatureError& error,
                            double error_px, double* terms) {
  const double a = shown.point.x / shown.point.z, b = shown.point.y / shown.point.z, n = shown.inverse_depth;
  double by_u[6] = {-n, 0.0, a * n, a * b, -(1.0 + a * a), b};
  double by_v[6] = {0.0, -n, b * n, 1.0 + b * b, -a * b, -a};
  for (int i = 0; i < 6; ++i) {
    const double u = k.fx * by_u[i], v = k.fy * by_v[i], part = error.unit_u * u + error.unit_v * v;
    by_u[i] = u - error.less_u * part;
    by_v[i] = v - error.less_v * part;
  }
  const double root = 1.0 / (1.0 + error.square() / (error_px * error_px * kWideErrors * kWideErrors));
  add_normal_terms<double>(by_u, error.u, root * root, terms);
  add_normal_terms<double>(by_v, error.v, root * root, terms);
}

}  // namespace spslam
