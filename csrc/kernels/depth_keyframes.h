// The maths of aligning a frame with depth keyframes, earlier frames' depth images: how far a surface point lies from
// the surface that they measured.
#pragma once

#include <cmath>
#include <cstdint>

#include "core/macros.h"
#include "core/math.h"
#include "core/vec.h"
#include "kernels/color_pose.h"
#include "kernels/earlier_frame.h"
#include "kernels/pixel_noise.h"
#include "kernels/robust_residual.h"
#include "spslam/gauss_newton.h"

namespace spslam {

// After the normal equations: the sum of weights and, of pairs of a pixel and a keyframe where the map is known too,
// the map's weighted squares and sum of weights. The cost's place holds the weighted squares of such pairs.
constexpr int kKeyframeTerms = kNormalTerms + 3;
// The equations of the pose and after them those of the gain.
constexpr int kJointNormals = kNormalTerms + kGainTerms;
// Four pixels whose inverse depths spread more than this share have an edge between them.
constexpr float kMaxInverseDepthSpread = 0.03f;
// A point whose depth differs from the surface's by more than this share is not on it.
constexpr float kMaxDepthDifference = 0.05f;
// The least and the most weight of the map against one keyframe's pixel.
constexpr double kMinMapShare = 1e-3, kMaxMapShare = 4.0;

// One of them with its poses read.
struct DepthKeyframe {
  const std::uint16_t* image;
  const std::uint8_t* intensities;  // null where there are none
  Pose<float> pose;
  ColorPose color;
  float log_gain;  // of its frame
  float scale;     // its intensities times this are as bright as the frame that is aligned
};

// By how much brighter than a frame of one log gain is one of another. In the dark nothing tells the gain, so that two
// frames' may differ by any number; the scale stays finite.
constexpr float kMostLogScale = 20.0f;
SPS_INLINE float brightness_scale(float log_gain, float own) {
  return std::exp(smaller(larger(own - log_gain, -kMostLogScale), kMostLogScale));
}

// The image in a row, of a frame at a pose.
SPS_INLINE DepthKeyframe keyframe_image(const DepthKeyframes& keyframes, std::int64_t row, const Pose<float>& pose) {
  const std::int64_t first = row * keyframes.height * keyframes.width;
  const std::uint8_t* intensities = keyframes.intensities ? keyframes.intensities + first : nullptr;
  return {keyframes.images + first, intensities, pose, {pose, 0.0f}, 0.0f, 1.0f};
}

SPS_INLINE DepthKeyframe load_depth_keyframe(const DepthKeyframes& keyframes, int k) {
  const float* pose = keyframes.poses + kPoseSize * keyframes.pose_rows[k];
  DepthKeyframe keyframe = keyframe_image(keyframes, keyframes.image_rows[k], load_pose(pose));
  keyframe.color = color_pose(keyframes.poses, keyframes.motions[k], keyframes.color_delay, pose);
  if (keyframes.log_gains) {
    keyframe.log_gain = keyframes.log_gains[keyframes.log_gain_stride * keyframes.pose_rows[k]];
    keyframe.scale = brightness_scale(keyframe.log_gain, *keyframes.frame_log_gain);
  }
  return keyframe;
}

// How many take part in an iteration.
SPS_INLINE int keyframes_in_use(const DepthKeyframes& keyframes, std::int64_t iteration) {
  return iteration >= keyframes.first_iteration ? keyframes.count : 0;
}

// The map's residual (m) at a pixel, where the map knows the surface.
struct MapResidual {
  float value;
  bool known;
};

// A point's signed distance (m) from the surface that a keyframe measured, positive beyond it, and its derivative by
// the point in the keyframe's camera axes.
struct SurfaceDistance {
  float value;
  Vec3<float> slope;
  bool known, near;  // near: the point is on that surface, not on another before or behind it
};

// Unknown between pixels without depth or with an edge. The inverse depth q of a plane is linear in the image, so
// z q(u, v) - 1 is linear in the point, and divided by the norm of its gradient a distance.
SPS_INLINE SurfaceDistance surface_distance(const DepthKeyframes& keyframes, const DepthKeyframe& keyframe,
                                            const FrameProjection& at) {
  const std::uint16_t* row = keyframe.image + at.row * keyframes.width + at.column;
  const std::uint16_t d00 = row[0], d01 = row[1], d10 = row[keyframes.width], d11 = row[keyframes.width + 1];
  if (d00 == 0 || d01 == 0 || d10 == 0 || d11 == 0) return {};
  const float q00 = 1.0f / (keyframes.unit * d00), q01 = 1.0f / (keyframes.unit * d01);
  const float q10 = 1.0f / (keyframes.unit * d10), q11 = 1.0f / (keyframes.unit * d11);
  const float most = larger(larger(q00, q01), larger(q10, q11));
  const float least = smaller(smaller(q00, q01), smaller(q10, q11));
  if (!(most - least < kMaxInverseDepthSpread * most)) return {};
  const BilinearValue q = bilinear_value(q00, q01, q10, q11, at.a, at.b);
  const float x = q.by_u * keyframes.intrinsics.fx, y = q.by_v * keyframes.intrinsics.fy;
  const Vec3<float> gradient{x, y, q.value - (x * at.in_camera.x + y * at.in_camera.y) * at.inverse_z};
  const float inverse_slope = 1.0f / larger(std::sqrt(dot(gradient, gradient)), 1e-6f);
  const float excess = at.in_camera.z * q.value - 1.0f;
  return {excess * inverse_slope, inverse_slope * gradient, true, std::fabs(excess) < kMaxDepthDifference};
}

// An earlier image's intensity at a projection, as bright as the frame, less a pixel's own; its derivatives by the
// place (1/px) and by the frame's log gain.
struct IntensityDifference {
  float value, by_u, by_v, by_gain;
};

// What would be brighter than white is white.
SPS_INLINE IntensityDifference scaled_difference(const BilinearValue& earlier, float scale, float intensity) {
  const float value = scale * earlier.value;
  if (value > 1.0f) return {1.0f - intensity, 0.0f, 0.0f, 0.0f};
  return {value - intensity, scale * earlier.by_u, scale * earlier.by_v, value};
}

SPS_INLINE IntensityDifference intensity_difference(const DepthKeyframes& keyframes, const DepthKeyframe& keyframe,
                                                    const FrameProjection& at, float intensity) {
  constexpr float kStep = 1.0f / 255.0f;
  const std::uint8_t* row = keyframe.intensities + at.row * keyframes.width + at.column;
  const BilinearValue value = bilinear_value(kStep * row[0], kStep * row[1], kStep * row[keyframes.width],
                                             kStep * row[keyframes.width + 1], at.a, at.b);
  return scaled_difference(value, keyframe.scale, intensity);
}

// The derivative of the difference by the point in the keyframe's camera axes, 1/m.
SPS_INLINE Vec3<float> intensity_by_point(const DepthKeyframes& keyframes, const IntensityDifference& difference,
                                          const FrameProjection& at) {
  const float x = difference.by_u * keyframes.intrinsics.fx * at.inverse_z;
  const float y = difference.by_v * keyframes.intrinsics.fy * at.inverse_z;
  return {x, y, -(x * at.in_camera.x + y * at.in_camera.y) * at.inverse_z};
}

// Adds the difference of intensities in meters, as many as the deviation of the sensor's noise is worth, to terms of
// the pose and of the gain. `lever` is by how much the color's pose moves with a step of the frame's.
template <class T>
SPS_INLINE void add_keyframe_intensity(const DepthKeyframes& keyframes, const DepthKeyframe& keyframe,
                                       const FrameProjection& at, const PixelNoise& noise, float width,
                                       const Vec3<float>& offset, float lever, T* terms, T* gain_terms) {
  const IntensityDifference difference = intensity_difference(keyframes, keyframe, at, noise.intensity);
  const float deviation = intensity_deviation(noise.sensor, difference.by_u, difference.by_v);
  const float meters = noise.intensity_meters / deviation;
  const Vec3<float> by_point = intensity_by_point(keyframes, difference, at);
  const Vec3<float> slope = keyframe.color.pose.rotation * (lever * meters * by_point);
  const T weight = static_cast<T>(robust_weight(difference.value, kRobustDeviations * width * deviation));
  add_weighted_residual(offset, meters * difference.value, slope, weight, terms);
  add_gain_residual(offset, meters * difference.value, slope, meters * difference.by_gain, weight, gain_terms);
}

// Where a keyframe's color image shows a pixel's color, `at` being where its depth image shows the pixel's surface.
SPS_INLINE FrameProjection color_projection(const DepthKeyframes& keyframes, const DepthKeyframe& keyframe,
                                            const PixelPoints& points, const FrameProjection& at) {
  if (points.lever == 0.0f && keyframe.color.lever == 0.0f) return at;
  return project_into_frame(keyframe.color.pose, keyframes.intrinsics, keyframes.height, keyframes.width,
                            points.color.world);
}

// Adds what a keyframe measured at a pixel's points to terms of type T: the distance from its surface, and where the
// noise of intensities is known their difference, to `gain_terms` too; nothing where the point falls off the image or
// its surface is unknown.
template <class T>
SPS_INLINE void add_depth_keyframe_residual(const DepthKeyframes& keyframes, const DepthKeyframe& keyframe,
                                            const PixelPoints& points, float kernel, const PixelNoise& noise,
                                            const MapResidual& map, T* terms, T* gain_terms) {
  const Vec3<float>&world = points.depth.world, &offset = points.depth.offset;
  const FrameProjection at =
      project_into_frame(keyframe.pose, keyframes.intrinsics, keyframes.height, keyframes.width, world);
  if (!at.inside) return;
  const SurfaceDistance surface = surface_distance(keyframes, keyframe, at);
  if (!surface.known) return;
  if (noise.sensor && keyframe.intensities && surface.near) {
    const FrameProjection color_at = color_projection(keyframes, keyframe, points, at);
    if (color_at.inside) {
      add_keyframe_intensity(keyframes, keyframe, color_at, noise, kernel / keyframes.kernel_end, points.color.offset,
                             1.0f + points.lever, terms, gain_terms);
    }
  }
  const float residual = surface.value, certainty = noise.keyframe_certainty;
  const T weight = static_cast<T>(certainty) * static_cast<T>(robust_weight(residual, kernel));
  add_weighted_residual(offset, residual, keyframe.pose.rotation * surface.slope, weight, terms);
  if (!map.known) return;
  const T map_weight = static_cast<T>(certainty) * static_cast<T>(robust_weight(map.value, kernel));
  const T squared = static_cast<T>(residual) * static_cast<T>(residual);
  terms[kNormalTerms - 1] += weight * squared;
  terms[kNormalTerms] += weight;
  terms[kNormalTerms + 1] += map_weight * static_cast<T>(map.value) * static_cast<T>(map.value);
  terms[kNormalTerms + 2] += map_weight;
}

// Weight of the map's equations against the mean of the keyframes': the squared ratio of the variances, as the map's
// error, unlike a sensor's noise, is alike for neighboring pixels and does not average out. 1 without common pixels.
SPS_INLINE double map_share(const double* keyframe_terms) {
  const double weights = keyframe_terms[kNormalTerms], map_weights = keyframe_terms[kNormalTerms + 2];
  if (!(weights > 1e-6 && map_weights > 1e-6)) return 1.0;
  const double map_variance = keyframe_terms[kNormalTerms + 1] / map_weights + 1e-12;
  const double ratio = keyframe_terms[kNormalTerms - 1] / weights / map_variance;
  const double share = ratio * ratio;
  return share < kMinMapShare ? kMinMapShare : share < kMaxMapShare ? share : kMaxMapShare;
}

// The equations that the step is solved from: those of the map times its share, and the mean of the keyframes'. `joint`
// [kJointNormals] gets those of the pose and, from `gain_terms` of the reference and the keyframes, of the gain.
SPS_INLINE void join_keyframe_terms(const double* map_terms, const double* keyframe_terms, const double* gain_terms,
                                    int count, double* joint) {
  const double share = count > 0 ? map_share(keyframe_terms) : 1.0, mean = count > 0 ? 1.0 / count : 0.0;
  for (int t = 0; t < kNormalTerms; ++t) {
    joint[t] = count > 0 ? share * map_terms[t] + mean * keyframe_terms[t] : map_terms[t];
  }
  for (int t = 0; t < kGainTerms; ++t) {
    joint[kNormalTerms + t] = count > 0 ? share * gain_terms[t] + mean * gain_terms[kGainTerms + t] : gain_terms[t];
  }
}

}  // namespace spslam
