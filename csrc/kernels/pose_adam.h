// Adam on a camera pose: unit quaternion (w, x, y, z) and translation.
#pragma once

#include <cmath>
#include <limits>

#include "core/macros.h"
#include "kernels/optimizer.h"
#include "spslam/types/camera.h"

namespace spslam {

constexpr int kQuaternionSize = 4;

// Gradient by the seven numbers from that by translation and by a left turn omega about the camera's center: as
// dq = (0, omega) q / 2, that in the unit quaternion's tangent space is 2 (0, g_omega) q.
template <class T>
SPS_INLINE void pose_gradient(const T* pose, const T* increment, T* gradient) {
  const T w = pose[0], x = pose[1], y = pose[2], z = pose[3];
  const T a = increment[3], b = increment[4], c = increment[5];
  gradient[0] = 2 * (-a * x - b * y - c * z);
  gradient[1] = 2 * (a * w + b * z - c * y);
  gradient[2] = 2 * (b * w + c * x - a * z);
  gradient[3] = 2 * (c * w + a * y - b * x);
  for (int k = 0; k < 3; ++k) gradient[kQuaternionSize + k] = increment[k];
}

// In place; `increment` [6] is d L / d translation and d L / d omega.
template <class T>
SPS_INLINE void pose_adam(const AdamCoefficients<T>& rotation, const AdamCoefficients<T>& translation,
                          const T* increment, T* pose, T* exp_avg, T* exp_avg_sq) {
  T gradient[kPoseSize];
  pose_gradient(pose, increment, gradient);
  T norm = 0;
  for (int k = 0; k < kPoseSize; ++k) {
    adam_update(k < kQuaternionSize ? rotation : translation, pose[k], gradient[k], exp_avg[k], exp_avg_sq[k]);
    if (k < kQuaternionSize) norm += pose[k] * pose[k];
  }
  norm = std::sqrt(norm);
  for (int k = 0; k < kQuaternionSize; ++k) pose[k] /= norm;
}

// The current pose of an optimization with its moments, and the best pose so far.
struct PoseSearch {
  float pose[kPoseSize], exp_avg[kPoseSize], exp_avg_sq[kPoseSize];
  float best[kPoseSize], best_loss;
};

SPS_INLINE PoseSearch start_pose_search(const float* start) {
  PoseSearch search{};
  for (int k = 0; k < kPoseSize; ++k) search.pose[k] = search.best[k] = start[k];
  search.best_loss = std::numeric_limits<float>::infinity();
  return search;
}

// Keeps the pose if its loss is the least so far, then takes the step. Where the loss is NaN the pose stays. A pose of
// NaN meets no surface and has a loss of 0.
SPS_INLINE void step_pose_search(const AdamCoefficients<float>& rotation, const AdamCoefficients<float>& translation,
                                 float loss, const float* increment, PoseSearch& search) {
  if (loss < search.best_loss) {
    search.best_loss = loss;
    for (int k = 0; k < kPoseSize; ++k) search.best[k] = search.pose[k];
  }
  if (loss == loss) pose_adam(rotation, translation, increment, search.pose, search.exp_avg, search.exp_avg_sq);
}

}  // namespace spslam
