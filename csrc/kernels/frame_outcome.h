// What the pose that tracking found says of the motion that a frame was rectified by.
#pragma once

#include <cmath>

#include "core/macros.h"
#include "spslam/track_frame.h"

namespace spslam {

// |a - sign b| of the quaternions of two poses.
SPS_INLINE double quaternion_distance(const float* a, const float* b, double sign) {
  double sum = 0.0;
  for (int i = 0; i < 4; ++i) {
    const double difference = static_cast<double>(a[i]) - sign * static_cast<double>(b[i]);
    sum += difference * difference;
  }
  return std::sqrt(sum);
}

// Angle between two poses, rad; exact for small ones too. NaN where a pose is.
SPS_INLINE double turn_between(const float* a, const float* b) {
  const double near = quaternion_distance(a, b, 1.0), opposite = quaternion_distance(a, b, -1.0);
  const double chord = near < opposite ? near : opposite;  // 2 sin(angle / 4)
  return near == near ? 4.0 * std::asin(chord < 2.0 ? 0.5 * chord : 1.0) : near;
}

// Distance between two poses, m.
SPS_INLINE double way_between(const float* a, const float* b) {
  double sum = 0.0;
  for (int i = 4; i < kPoseSize; ++i) {
    const double difference = static_cast<double>(a[i]) - static_cast<double>(b[i]);
    sum += difference * difference;
  }
  return std::sqrt(sum);
}

// A readout takes no longer than a frame, so that smaller turns bend nothing. Nothing is known of a pose of NaN, nor
// done about it here.
SPS_INLINE FrameOutcome frame_outcome(const PredictionLimits& limits, const float* predicted, const float* pose,
                                      float readout, float seconds) {
  const double turn = turn_between(predicted, pose);
  if (way_between(predicted, pose) > limits.far_way || turn > limits.far_turn) return FrameOutcome::kFar;
  const bool bends = turn > limits.bent_turn &&
                     turn * std::fabs(static_cast<double>(readout)) > limits.bent_turn * static_cast<double>(seconds);
  return bends ? FrameOutcome::kBent : FrameOutcome::kSettled;
}

}  // namespace spslam
