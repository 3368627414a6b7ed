// The maths of registering depth images: what a pixel of one is measured against in another, and whether it fits.
#pragma once

#include <cmath>
#include <cstdint>

#include "core/macros.h"
#include "core/vec.h"
#include "kernels/gauss_newton.h"
#include "spslam/depth_image_alignment.h"

namespace spslam {

// m, that is left of noise however small, of the steps of depth images.
constexpr float kLeastDepthDeviation = 2e-4f;

// A pair's rows, and whether there are such.
struct ImagePair {
  std::int64_t source, target;
  bool exists;
};

SPS_INLINE ImagePair load_pair(const ImagePairs& pairs, std::int64_t i, std::int64_t sources, std::int64_t targets) {
  const std::int64_t source = pairs.rows[2 * i], target = pairs.rows[2 * i + 1];
  return {source, target, source >= 0 && source < sources && target >= 0 && target < targets};
}

// What a source is measured against: the target at the origin, and the noise.
SPS_INLINE void load_target(const GaussNewtonOptions& options, std::int64_t target, EarlierFrames& frames) {
  frames.noise = options.noise ? load_sensor_noise(options.noise) : SensorNoise{};
  const Pose<float> origin{{{1.0f, 0.0f, 0.0f, 0.0f, 1.0f, 0.0f, 0.0f, 0.0f, 1.0f}}, {0.0f, 0.0f, 0.0f}};
  frames.keyframes[0] = keyframe_image(options.depth_keyframes, target, origin);
  frames.color.lever = 0.0f;
}

// Adds the residuals of one drawn pixel of a source to terms [kKeyframeTerms].
template <class T>
SPS_INLINE void add_alignment_residuals(const Measurement& measure, const std::int32_t* record, const Pose<float>& pose,
                                        T* terms) {
  const Pixel pixel = unpack_pixel(record);
  if (!(pixel.depth > 0.0f)) return;
  const SurfacePoint point = surface_point(pixel, pose, measure.options->intrinsics);
  T of_no_gain[kGainTerms] = {};
  add_keyframe_residuals(measure, pixel, point, noise_of(measure, pixel), {0.0f, false}, 0, 1, terms, of_no_gain);
}

// The step that the sums over a pair's pixels give.
SPS_INLINE void alignment_step(const double* keyframe_terms, double damping, float* pose) {
  const double map_terms[kTrackingTerms] = {}, gain_terms[kAllGainTerms] = {};
  double joint[kJointNormals];
  float steps[2], hessian[36];
  join_keyframe_terms(map_terms, keyframe_terms, gain_terms, 1, joint);
  tracking_step(map_terms, joint, damping, 0.0, pose, steps, hessian);
}

template <class T>
SPS_INLINE void add_squares(const Vec3<float>& slope, const Vec3<float>& arm, T* terms) {
  const Vec3<float> turn = cross(arm, slope);
  const T row[6] = {slope.x, slope.y, slope.z, turn.x, turn.y, turn.z};
  int at = 0;
  for (int a = 0; a < 6; ++a) {
    for (int b = a; b < 6; ++b) terms[at++] += row[a] * row[b];
  }
}

// The derivative by a point of the intensity that it falls on, in deviations of a difference; central differences.
SPS_INLINE Vec3<float> intensity_slope(const DepthKeyframes& images, const std::uint8_t* image,
                                       const SensorNoise& noise, std::int64_t row, std::int64_t column,
                                       const Vec3<float>& point) {
  constexpr float kStep = 1.0f / 255.0f;
  const std::int64_t w = images.width, h = images.height;
  const std::int64_t left = column > 0 ? column - 1 : 0, right = column + 1 < w ? column + 1 : w - 1;
  const std::int64_t above = row > 0 ? row - 1 : 0, below = row + 1 < h ? row + 1 : h - 1;
  const float across = 0.5f * kStep * (static_cast<float>(image[row * w + right]) - image[row * w + left]);
  const float down = 0.5f * kStep * (static_cast<float>(image[below * w + column]) - image[above * w + column]);
  const float deviation = intensity_deviation(&noise, across, down);
  const float scale = std::sqrt(intensity_share(noise)) / deviation, inverse_z = 1.0f / point.z;
  const float u = scale * across * images.intrinsics.fx * inverse_z;
  const float v = scale * down * images.intrinsics.fy * inverse_z;
  return {u, v, -(u * point.x + v * point.y) * inverse_z};
}

// Adds what one pixel of a source says of a pose to terms [kComparisonTerms].
template <class T>
SPS_INLINE void add_comparison(const GaussNewtonOptions& options, const EarlierFrames& frames,
                               const ComparisonOptions& comparison, const std::int32_t* record, const float* normal,
                               const Pose<float>& pose, T* terms) {
  const DepthKeyframes& images = options.depth_keyframes;
  const Pixel pixel = unpack_pixel(record);
  if (!(pixel.depth > 0.0f)) return;
  const SurfacePoint at = surface_point(pixel, pose, options.intrinsics);
  const Vec3<float> point = at.world;
  if (!(point.z > kMinEarlierDepth)) return;
  const Intrinsics& k = images.intrinsics;
  const float u = point.x / point.z * k.fx + k.cx + 0.5f, v = point.y / point.z * k.fy + k.cy + 0.5f;
  if (!(u >= 0.0f && v >= 0.0f && u < static_cast<float>(images.width) && v < static_cast<float>(images.height)))
    return;
  const std::int64_t row = static_cast<std::int64_t>(v), column = static_cast<std::int64_t>(u);
  const std::uint16_t stored = frames.keyframes[0].image[row * images.width + column];
  if (stored == 0) return;
  const float depth = images.unit * static_cast<float>(stored);
  const float deviation = std::fmax(std::sqrt(depth_variance(frames.noise.depth, depth)), kLeastDepthDeviation);
  const float behind = point.z - depth, tolerance = comparison.tolerance + comparison.tolerance_deviations * deviation;
  terms[0] += T(1);
  if (behind < -comparison.clear_tolerances * tolerance) terms[2] += T(1);
  if (!(std::fabs(behind) < tolerance)) return;
  terms[1] += T(1);
  T* squares = terms + kComparisonCounts + kComparisonMoments;
  const Vec3<float> own{normal[0], normal[1], normal[2]};
  add_squares((1.0f / deviation) * (pose.rotation * own), at.offset, squares);
  const std::uint8_t* image = frames.keyframes[0].intensities;
  if (!image) return;
  add_squares(intensity_slope(images, image, frames.noise, row, column, point), at.offset, squares);
  const T one = luma(pixel.color), other = static_cast<T>(image[row * images.width + column]) / T(255);
  const T moments[kComparisonMoments] = {one, other, one * one, other * other, one * other};
  for (int i = 0; i < kComparisonMoments; ++i) terms[kComparisonCounts + i] += moments[i];
}

}  // namespace spslam
