// The maths of measuring when a camera takes its images: one Gauss-Newton step for the relative pose of two frames, the
// delay of color and the readout together, in which surface and brightness of all rows have to agree.
#pragma once

#include <cmath>
#include <cstdint>

#include "core/macros.h"
#include "core/vec.h"
#include "kernels/depth_keyframes.h"
#include "spslam/capture_timing.h"

namespace spslam {

// The pose's step and the times.
constexpr int kTimingUnknowns = 6 + kTimings, kTimingNormals = kTimingUnknowns * (kTimingUnknowns + 1) / 2;
// The upper triangle of the normal matrix row by row, the gradient, and the number of differences of intensity.
constexpr int kTimingTerms = kTimingNormals + kTimingUnknowns + 1;
// As many as a frame's differences of intensity are worth: those of neighboring pixels are wrong alike.
constexpr double kIndependentDifferences = 300.0;
// s, by which a frame's own estimate may be off however many pixels it has: exposures, rolling shutters and a camera
// that does not move evenly.
constexpr double kFrameDeviation = 0.004;
// s, of the first guess, 0.
constexpr double kFirstDeviation = 0.005;
// s: the estimate is taken to be no better than this, so that it follows a clock that drifts.
constexpr double kLeastDeviation = 0.001;
// Of the difference between a frame's estimate and what is known: it counts as no larger, as differences of intensities
// are linear over few pixels only, and a camera does not move evenly.
constexpr double kMostDeviations = 2.5;
// s: no estimate is larger, as images farther apart in time are not compensated.
constexpr double kMostTime = 0.9 * static_cast<double>(kMaxColorDelay);
// 1/s^2: of less than a second's deviation a frame says nothing.
constexpr double kLeastInformation = 1.0;
// s: a smaller time is none.
constexpr double kLeastDelay = 0.0015, kLeastReadout = 0.003;

// Arms of the cross, px, that a plane is measured by: so long that noise turns it by 1 / (2 kCrossShare) or less.
constexpr float kCrossShare = 5.0f;
constexpr std::int64_t kLeastCross = 3, kMostCross = 24;
// A cross is bent where its middle is off by more deviations of depth; the two ends and the middle have 2.4 together.
constexpr float kBentDeviations = 8.0f;

// Of depth, added to the width of the robust kernel of distances: where brightness has moved the pose, the surface is
// off, and that is what tells the delay.
constexpr float kSurfaceWidth = 0.03f;

template <class T>
SPS_INLINE void add_timing_row(const T (&row)[kTimingUnknowns], T residual, T weight, T* terms) {
  int at = 0;
  for (int a = 0; a < kTimingUnknowns; ++a) {
    for (int b = a; b < kTimingUnknowns; ++b) terms[at++] += weight * row[a] * row[b];
  }
  for (int a = 0; a < kTimingUnknowns; ++a) terms[at++] += weight * row[a] * residual;
}

// A keyframe, how the camera moved at it, and by how much the readout that is known is longer than the one by which its
// images were rectified, s.
struct MovingKeyframe {
  DepthKeyframe keyframe;
  CameraVelocity velocity;
  float unrectified;
};

SPS_INLINE MovingKeyframe load_moving_keyframe(const DepthKeyframes& keyframes, int k, const float* timing) {
  const float* pose = keyframes.poses + kPoseSize * keyframes.pose_rows[k];
  const float unrectified = keyframes.readouts ? timing[1] - keyframes.readouts[keyframes.image_rows[k]] : 0.0f;
  return {load_depth_keyframe(keyframes, k), camera_velocity(keyframes.poses, keyframes.motions[k], pose), unrectified};
}

// The frame that is compared: where and how the camera is when it takes depth and color.
struct MovingFrame {
  Pose<float> pose;
  ColorPose color;
  CameraVelocity velocity;
};

SPS_INLINE MovingFrame load_moving_frame(const DepthKeyframes& keyframes, const float* pose) {
  const FrameMotion& motion = keyframes.frame_motion;
  return {load_pose(pose), color_pose(keyframes.poses, motion, keyframes.color_delay, pose),
          camera_velocity(keyframes.poses, motion, pose)};
}

// The distance (m) of a point from the plane that a keyframe's depth image shows around its projection, as of
// `SurfaceDistance`, and the variance of that.
struct WidePlane {
  float distance, variance;
  Vec3<float> slope;
  bool known;
};

// From the inverse depths of a cross so wide that noise hardly turns the plane: the slope between neighboring pixels is
// mostly noise, and would seem to hold a pose that brightness moves. Unknown where the cross is not on a plane.
SPS_INLINE WidePlane wide_plane(const DepthKeyframes& keyframes, const DepthKeyframe& keyframe,
                                const FrameProjection& at, const DepthNoise& noise) {
  const Intrinsics& k = keyframes.intrinsics;
  const float z = at.in_camera.z, variance = depth_variance(noise, z), deviation = std::sqrt(variance);
  const float wanted = kCrossShare * deviation * k.fx * at.inverse_z;
  if (!(wanted < static_cast<float>(kMostCross))) return {};
  const std::int64_t arm = wanted < kLeastCross ? kLeastCross : static_cast<std::int64_t>(wanted);
  const std::int64_t row = at.row + (at.b > 0.5f), column = at.column + (at.a > 0.5f);
  if (row < arm || column < arm || row + arm >= keyframes.height || column + arm >= keyframes.width) return {};
  const std::uint16_t* center = keyframe.image + row * keyframes.width + column;
  const std::uint16_t d = center[0], left = center[-arm], right = center[arm], up = center[-arm * keyframes.width],
                      down = center[arm * keyframes.width];
  if (d == 0 || left == 0 || right == 0 || up == 0 || down == 0) return {};
  const float q = 1.0f / (keyframes.unit * d), q_left = 1.0f / (keyframes.unit * left),
              q_right = 1.0f / (keyframes.unit * right), q_up = 1.0f / (keyframes.unit * up),
              q_down = 1.0f / (keyframes.unit * down);
  const float most = kBentDeviations * deviation * at.inverse_z * at.inverse_z;
  if (!(std::fabs(q_left + q_right - 2.0f * q) < most && std::fabs(q_up + q_down - 2.0f * q) < most)) return {};
  const float half = 0.5f / static_cast<float>(arm), by_u = half * (q_right - q_left), by_v = half * (q_down - q_up);
  const float u = static_cast<float>(at.column - column) + at.a, v = static_cast<float>(at.row - row) + at.b;
  const float x = by_u * k.fx, y = by_v * k.fy, value = q + by_u * u + by_v * v;
  const Vec3<float> gradient{x, y, value - (x * at.in_camera.x + y * at.in_camera.y) * at.inverse_z};
  const float inverse_slope = 1.0f / std::fmax(std::sqrt(dot(gradient, gradient)), 1e-6f);
  constexpr float kSurface = kSurfaceDeviation * kSurfaceDeviation;
  return {(z * value - 1.0f) * inverse_slope, kSurface + 2.0f * variance, inverse_slope * gradient, true};
}

// By how much a point moves, in the world, with each second that a camera carries it along.
SPS_INLINE Vec3<float> carried(const CameraVelocity& velocity, const Vec3<float>& offset) {
  return velocity.linear + cross(velocity.angular, offset);
}

// Adds what one pixel says against one keyframe to terms [kTimingTerms], weighted by inverse variances. The derivative
// of a residual by a time is that of a point which the frame's camera carries along, less that of one which the
// keyframe's does. The frame was rectified by the readout that is known, the keyframe perhaps by another one.
template <class T>
SPS_INLINE void add_timing_residuals(const DepthKeyframes& keyframes, const MovingKeyframe& moving,
                                     const MovingFrame& frame, const Pixel& pixel, const Intrinsics& intrinsics,
                                     const SensorNoise& sensor, T* terms) {
  const DepthKeyframe& keyframe = moving.keyframe;
  if (!(pixel.depth > 0.0f && moving.velocity.known && frame.velocity.known)) return;
  const PixelPoints points = pixel_points(pixel, surface_point(pixel, frame.pose, intrinsics), frame.color, intrinsics);
  const FrameProjection at =
      project_into_frame(keyframe.pose, keyframes.intrinsics, keyframes.height, keyframes.width, points.depth.world);
  if (!at.inside) return;
  const SurfaceDistance surface = surface_distance(keyframes, keyframe, at);
  if (!(surface.known && surface.near)) return;
  const FrameProjection color_at = color_projection(keyframes, keyframe, points, at);
  if (!color_at.inside) return;
  // The frame's images are of the keyframes' size, whatever its pixels are of.
  const float own_row = (pixel.v - intrinsics.cy) / intrinsics.fy * keyframes.intrinsics.fy + keyframes.intrinsics.cy;
  const float own_share = row_share(own_row, keyframes.height);
  const WidePlane plane = wide_plane(keyframes, keyframe, at, sensor.depth);
  if (plane.known) {
    const Vec3<float> facing = keyframe.pose.rotation * plane.slope, turned = cross(points.depth.offset, facing);
    const Vec3<float> by_frame = own_share * carried(frame.velocity, points.depth.offset);
    const Vec3<float> by_keyframe = row_share(at.row + at.b, keyframes.height) *
                                    carried(moving.velocity, points.depth.world - keyframe.pose.translation);
    const T row[kTimingUnknowns] = {facing.x, facing.y, facing.z, turned.x,
                                    turned.y, turned.z, 0,        dot(facing, by_frame - by_keyframe)};
    const float width = kRobustDeviations * std::sqrt(plane.variance) + kSurfaceWidth * at.in_camera.z;
    const float distance = plane.distance - moving.unrectified * dot(facing, by_keyframe);
    const float weight = robust_weight(distance, width) / plane.variance;
    add_timing_row(row, static_cast<T>(distance), static_cast<T>(weight), terms);
  }
  const IntensityDifference difference = intensity_difference(keyframes, keyframe, color_at, luma(pixel.color));
  const float deviation = intensity_deviation(&sensor, difference.by_u, difference.by_v);
  const Vec3<float> slope = keyframe.color.pose.rotation * intensity_by_point(keyframes, difference, color_at);
  const Vec3<float> moved = (1.0f + frame.color.lever) * slope, arm = cross(points.color.offset, moved);
  const Vec3<float> by_frame = carried(frame.velocity, points.color.offset);
  const Vec3<float> by_keyframe = carried(moving.velocity, points.color.world - keyframe.color.pose.translation);
  const float other_share = row_share(color_at.row + color_at.b, keyframes.height);
  const T color_row[kTimingUnknowns] = {moved.x,
                                        moved.y,
                                        moved.z,
                                        arm.x,
                                        arm.y,
                                        arm.z,
                                        dot(slope, by_frame - by_keyframe),
                                        dot(slope, own_share * by_frame - other_share * by_keyframe)};
  const float value = difference.value - moving.unrectified * other_share * dot(slope, by_keyframe);
  const float weight = intensity_share(sensor) * robust_weight(value, kRobustDeviations * deviation);
  add_timing_row(color_row, static_cast<T>(value), static_cast<T>(weight / (deviation * deviation)), terms);
  terms[kTimingTerms - 1] += T(1);
}

// What pairs of frames say of the times: information (1/s^2), symmetric, and gradient (1/s).
struct TimingEvidence {
  double information[kTimings][kTimings], gradient[kTimings];
};

// Adds that of a pair's sums. Its relative pose is eliminated, as either pose may be off: what is left is what surface
// and brightness, and rows, disagree on.
SPS_INLINE void add_timing_evidence(const double* terms, TimingEvidence& evidence) {
  const double count = terms[kTimingTerms - 1];
  if (!(count > 0.0)) return;
  double full[kTimingUnknowns][kTimingUnknowns], hessian[36], gradient[6], trace = 0.0;
  int at = 0;
  for (int a = 0; a < kTimingUnknowns; ++a) {
    for (int b = a; b < kTimingUnknowns; ++b) full[a][b] = full[b][a] = terms[at++];
  }
  for (int a = 0; a < 6; ++a) {
    for (int b = 0; b < 6; ++b) hessian[6 * a + b] = full[a][b];
    gradient[a] = terms[kTimingNormals + a];
    trace += full[a][a];
  }
  const double independent = count > kIndependentDifferences ? kIndependentDifferences / count : 1.0;
  const double damping = 1e-9 * trace + 1e-12;
  double by_pose[6];  // negative solutions
  solve_damped_6x6<double>(hessian, gradient, 0.0, damping, 1e-12, by_pose);
  for (int i = 0; i < kTimings; ++i) {
    double mixed[6], solution[6];
    for (int a = 0; a < 6; ++a) mixed[a] = full[a][6 + i];
    solve_damped_6x6<double>(hessian, mixed, 0.0, damping, 1e-12, solution);
    double slope = terms[kTimingNormals + 6 + i];
    for (int a = 0; a < 6; ++a) slope += mixed[a] * by_pose[a];
    evidence.gradient[i] += independent * slope;
    for (int j = 0; j < kTimings; ++j) {
      double information = full[6 + i][6 + j];
      for (int a = 0; a < 6; ++a) information += full[a][6 + j] * solution[a];
      evidence.information[i][j] += independent * information;
    }
  }
}

// Takes account of the evidence of a frame against all keyframes.
SPS_INLINE void update_capture_timing(const TimingEvidence& evidence, double* state, float* timing) {
  const double a = evidence.information[0][0], b = evidence.information[0][1], c = evidence.information[1][1];
  const double determinant = a * c - b * b;
  if (!(a > kLeastInformation && c > kLeastInformation && determinant > 1e-6 * a * c)) return;
  const double variance[kTimings] = {c / determinant, a / determinant};
  const double off[kTimings] = {(b * evidence.gradient[1] - c * evidence.gradient[0]) / determinant,
                                (b * evidence.gradient[0] - a * evidence.gradient[1]) / determinant};
  constexpr double kFirst = 1.0 / (kFirstDeviation * kFirstDeviation),
                   kMost = 1.0 / (kLeastDeviation * kLeastDeviation);
  double steps[kTimings];
  for (int i = 0; i < kTimings; ++i) {
    steps[i] = static_cast<double>(timing[i]) + off[i] - state[2 * i];
    if (!std::isfinite(steps[i])) return;
  }
  for (int i = 0; i < kTimings; ++i) {
    double* own = state + 2 * i;
    const double known = own[1] > kFirst ? own[1] : kFirst, of_frame = variance[i] + kFrameDeviation * kFrameDeviation;
    const double most = kMostDeviations * std::sqrt(of_frame + 1.0 / known), sum = known + 1.0 / of_frame;
    const double moved = own[0] + std::fmin(std::fmax(steps[i], -most), most) / (of_frame * sum);
    own[0] = std::fmin(std::fmax(moved, -kMostTime), kMostTime);
    own[1] = std::fmin(sum, kMost);
  }
  for (int i = 0; i < kTimings; ++i) {
    const double least = i == 0 ? kLeastDelay : kLeastReadout;
    timing[i] = std::fabs(state[2 * i]) < least ? 0.0f : static_cast<float>(state[2 * i]);
  }
}

}  // namespace spslam
