// Pixels of depth keyframes read ahead: their images are far larger than the caches, and a frame's points fall anywhere
// into them.
#pragma once

#include <cstdint>

#include "kernels/depth_keyframes.h"

namespace spslam {

// Points whose look-ups are under way together.
constexpr std::int64_t kPointsAhead = 32;

// Reads what will be needed soon; nothing waits for the value. For images that saves more time than a prefetch
// (docs/experiments/2026-11-waiting-for-memory.md).
template <class T>
inline void touch(const T* at) {
  (void)*static_cast<const volatile T*>(at);
}

// Asks for what a keyframe's images have around the projection of a world point.
inline void prefetch_keyframe(const DepthKeyframes& keyframes, const DepthKeyframe& keyframe,
                              const Vec3<float>& world) {
  const FrameProjection at =
      project_into_frame(keyframe.pose, keyframes.intrinsics, keyframes.height, keyframes.width, world);
  if (!at.inside) return;
  const std::int64_t pixel = at.row * keyframes.width + at.column;
  touch(keyframe.image + pixel);
  __builtin_prefetch(keyframe.image + pixel + keyframes.width);
  if (!keyframe.intensities) return;
  __builtin_prefetch(keyframe.intensities + pixel);
  __builtin_prefetch(keyframe.intensities + pixel + keyframes.width);
}

}  // namespace spslam
