// Camera intrinsics, and the layout of a pose in memory.
#pragma once

namespace spslam {

// Pinhole intrinsics, px.
struct Intrinsics {
  float fx, fy, cx, cy;
};

constexpr int kPoseSize = 7;  // unit quaternion (w, x, y, z), translation (m)

}  // namespace spslam
