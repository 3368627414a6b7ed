// Where a camera was when it took a color image that is not of the moment of its depth image.
#pragma once

#include <cmath>

#include "core/macros.h"
#include "core/vec.h"
#include "kernels/surface_point.h"
#include "spslam/gauss_newton.h"

namespace spslam {

// s: a color image farther from its depth image than this is none of that frame.
constexpr float kMaxColorDelay = 0.1f;
// rad, m, between the two: what moves by more has jumped.
constexpr float kMaxColorTurn = 0.15f, kMaxColorTranslation = 0.15f;

// How a camera moves at a frame, in world axes; not where that is unknown.
struct CameraVelocity {
  Vec3<float> angular, linear;  // rad/s, m/s
  bool known;
};

// Of a frame at a pose [7], from the one before.
SPS_INLINE CameraVelocity camera_velocity(const float* poses, const FrameMotion& motion, const float* pose) {
  if (motion.row < 0) return {};
  const float* before = poses + kPoseSize * motion.row;
  const Quaternion<float> q0 = normalized(Quaternion<float>{before[0], before[1], before[2], before[3]});
  const Quaternion<float> q1 = normalized(Quaternion<float>{pose[0], pose[1], pose[2], pose[3]});
  const float rate = 1.0f / motion.seconds;
  const Vec3<float> way{pose[4] - before[4], pose[5] - before[5], pose[6] - before[6]};
  return {rate * quaternion_log(q1 * Quaternion<float>{q0.w, -q0.x, -q0.y, -q0.z}), rate * way, true};
}

// By what share of the readout the row of a pixel is read after the middle one.
SPS_INLINE float row_share(float v, std::int64_t height) {
  return v / static_cast<float>(height - 1) - 0.5f;
}

struct ColorPose {
  Pose<float> pose;
  float lever;  // by how much more than the depth image's pose it moves with a step of that; 0: it is the same pose
};

// Of a frame at a pose [7], moving on as it came: later than its depth image by what the stamps say and `delay` (s; may
// be null: they are of one moment).
SPS_INLINE ColorPose color_pose(const float* poses, const FrameMotion& motion, const float* delay, const float* pose) {
  const ColorPose still{load_pose(pose), 0.0f};
  if (!delay) return still;
  const float late = *delay + motion.color_offset;
  if (late == 0.0f || !(std::fabs(late) < kMaxColorDelay)) return still;
  const CameraVelocity velocity = camera_velocity(poses, motion, pose);
  const Vec3<float> turn = late * velocity.angular, way = late * velocity.linear;
  const bool moved_on =
      dot(turn, turn) < kMaxColorTurn * kMaxColorTurn && dot(way, way) < kMaxColorTranslation * kMaxColorTranslation;
  if (!velocity.known || !moved_on) return still;
  const Quaternion<float> q = normalized(Quaternion<float>{pose[0], pose[1], pose[2], pose[3]});
  return {{rotation(quaternion_exp(turn) * q), still.pose.translation + way}, late / motion.seconds};
}

// A pixel's surface point as the depth image has it, and where the color image sees that pixel: elsewhere if it is of
// another moment.
struct PixelPoints {
  SurfacePoint depth, color;
  float lever;  // of `ColorPose`
};

SPS_INLINE PixelPoints pixel_points(const Pixel& pixel, const SurfacePoint& depth, const ColorPose& color,
                                    const Intrinsics& intrinsics) {
  if (color.lever == 0.0f) return {depth, depth, 0.0f};
  return {depth, surface_point(pixel, color.pose, intrinsics), color.lever};
}

}  // namespace spslam
