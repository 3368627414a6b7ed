// The maths of point-to-plane ICP with projective association: the distance of one point from the plane it falls on.
#pragma once

#include <cmath>
#include <cstdint>

#include "core/macros.h"
#include "core/vec.h"
#include "kernels/gauss_newton.h"
#include "spslam/projective_icp.h"

namespace spslam {

// Adds the residual n . (T x - v) of a point x against the vertex v, of normal n, that its projection falls on; nothing
// where there is none, or where it is farther than max_distance.
template <class T>
SPS_INLINE void add_icp_residual(const SurfaceMaps& target, const float* point, const Pose<float>& pose,
                                 float max_distance, float kernel, T* terms) {
  const Vec3<float> offset = pose.rotation * Vec3<float>{point[0], point[1], point[2]};
  const Vec3<float> moved = offset + pose.translation;
  if (!(moved.z > 0.0f)) return;
  const Intrinsics& k = target.intrinsics;
  const float u = std::floor(moved.x / moved.z * k.fx + k.cx + 0.5f);
  const float v = std::floor(moved.y / moved.z * k.fy + k.cy + 0.5f);
  if (!(u >= 0.0f && u < static_cast<float>(target.width) && v >= 0.0f && v < static_cast<float>(target.height)))
    return;
  const std::int64_t at = 3 * (static_cast<std::int64_t>(v) * target.width + static_cast<std::int64_t>(u));
  const Vec3<float> vertex{target.vertices[at], target.vertices[at + 1], target.vertices[at + 2]};
  const Vec3<float> normal{target.normals[at], target.normals[at + 1], target.normals[at + 2]};
  if (!(vertex.z > 0.0f) || !(dot(normal, normal) > 0.0f)) return;
  const Vec3<float> difference = moved - vertex;
  if (!(dot(difference, difference) < max_distance * max_distance)) return;
  add_robust_residual(offset, dot(normal, difference), normal, {kernel, kernel, kernel}, 1.0f, terms);
}

}  // namespace spslam
