// Gradient of a ray's losses by the pose of its camera.
#pragma once

#include "core/macros.h"
#include "core/vec.h"

namespace spslam {

// Sums over the ray's samples.
struct RayPoseGradient {
  Vec3<float> translation;  // of d L / d point
  Vec3<float> moment;       // of depth times d L / d point
};

SPS_INLINE void add_point_gradient(const Vec3<float>& by_point, float depth, RayPoseGradient& sums) {
  sums.translation = sums.translation + by_point;
  sums.moment = sums.moment + depth * by_point;
}

// d L / d translation, and d L / d rotation about the camera's center.
struct PoseGradient {
  float values[6];
};

SPS_INLINE PoseGradient pose_gradient(const RayPoseGradient& sums, const Vec3<float>& direction) {
  const Vec3<float> translation = sums.translation, rotation = cross(direction, sums.moment);
  return {translation.x, translation.y, translation.z, rotation.x, rotation.y, rotation.z};
}

}  // namespace spslam
