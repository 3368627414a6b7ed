// What image features say of a camera's pose: reprojection errors of surface points that earlier frames have seen, and
// of what they saw beyond the range of depth. On the host alone, as there are hundreds of features; in double
// precision.
//
// A step of a pose (m, rad) moves the camera by the former and turns it about its center by the latter, in world axes.
#pragma once

#include <cstdint>

#include "core/device.h"

namespace spslam {

// Surface points [count, 3] in the world (m), where the frame shows them [count, 2] (px), and the standard deviations
// of their depths along their lines of sight [count, 3] (m).
struct SeenPoints {
  const double *points, *positions, *deviations;
  std::int64_t count;
};

// What an earlier frame at `origin` [3] saw beyond the range of its depth: directions [count, 3], 1 along its axis,
// where the frame shows it [count, 2] (px), and that range [count] (m).
struct SeenRays {
  const double *origin, *directions, *positions, *beyond;
  std::int64_t count;
};

struct FeatureCamera {
  double fx, fy, cx, cy;  // px
};

// How many features agree with a pose, matrix and gradient by a step of it.
struct FeatureEquations {
  std::int64_t agreeing;
  double hessian[36], gradient[6];
};

// Of points at a pose T_world_camera [4, 4]; closer than `error_px`, a position agrees. As the camera moves away from
// where a point was measured, the error of its depth shows: it moves the point along its epipolar line by d for each
// deviation, and errors there count by e / sqrt(e^2 + (3 d)^2), e being error_px.
FeatureEquations point_equations(Cpu device, const SeenPoints& seen, const FeatureCamera& camera, const double* pose,
                                 double error_px);

// Which points agree, alone: `agrees` [count].
void agreeing_points(Cpu device, const SeenPoints& seen, const FeatureCamera& camera, const double* pose,
                     double error_px, bool* agrees);

// The same of rays beyond the range z of depth: at an inverse depth n = 1/2z, give or take 4 n. The derivative d of a
// position by the inverse depth says how far it may be off along its epipolar line: errors there count by
// e / sqrt(e^2 + (4 n |d|)^2). So rays tell how the camera has turned, and, the farther it has moved, the more where
// to, but not how far. Each weighs at most as one of `least` that agree.
FeatureEquations ray_equations(Cpu device, const SeenRays& seen, const FeatureCamera& camera, const double* pose,
                               double error_px, std::int64_t least);

// From the pose of a frame's depth image to that of its color image: `share` of the motion since the pose `before` [7]
// (quaternion w, x, y, z, translation) on top; where `before` is null the two are one.
struct FeatureMotion {
  const double* before;
  double share;
};

struct HoldOptions {
  double error_px;
  std::int64_t least;  // points that must agree
};

// The pose that surface and image features agree on best, by Gauss-Newton from `pose` [7], where surface has put the
// camera, and `information` [6, 6] of that; rays are of `groups` earlier frames. Writes `held` [7] and returns how many
// points agreed, or -1 where these were fewer than the least.
std::int64_t hold_pose(Cpu device, const SeenPoints& points, const SeenRays* rays, std::int64_t groups,
                       const FeatureCamera& camera, const FeatureMotion& motion, const double* pose,
                       const double* information, const HoldOptions& options, double* held);

}  // namespace spslam
