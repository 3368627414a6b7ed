// The maths of direct alignment: the intensity of a surface point in an earlier frame's small gray image, compared with
// the intensity of its pixel now.
#pragma once

#include <cmath>
#include <cstdint>

#include "core/macros.h"
#include "core/vec.h"
#include "kernels/depth_keyframes.h"
#include "kernels/earlier_frame.h"
#include "kernels/pixel_record.h"
#include "kernels/robust_residual.h"
#include "kernels/surface_point.h"
#include "spslam/gauss_newton.h"

namespace spslam {

// A point is compared with a cell of the reference only if their depths agree to this share: else one occludes the
// other.
constexpr float kReferenceDepthAgreement = 0.1f;

struct ReferenceCorner {
  float intensity, depth;
};

SPS_INLINE ReferenceCorner reference_corner(const ReferenceImage& image, std::int64_t row, std::int64_t column) {
  const float* cell = image.cells + 2 * (row * image.width + column);
  return {cell[0], cell[1]};
}

// Adds the difference between the reference's intensity at the projection of the world point and the pixel's own, in
// units of `weight` m, to hessian and gradient (terms of type T), not to the cost, and to those of the gain. `pose` is
// where the reference's colors were taken, `scale` makes it as bright as the frame, `lever` is by how much the color's
// pose moves with a step of the frame's.
// Nothing where the point falls off the image, or on a cell without depth or of another depth.
template <class T>
SPS_INLINE void add_intensity_residual(const ReferenceImage& image, const Pose<float>& pose, float scale,
                                       const Pixel& pixel, const SurfacePoint& point, float lever, T* terms,
                                       T* gain_terms) {
  if (!(pixel.depth > 0.0f)) return;
  const FrameProjection at = project_into_frame(pose, image.intrinsics, image.height, image.width, point.world);
  if (!at.inside) return;
  const ReferenceCorner c00 = reference_corner(image, at.row, at.column),
                        c01 = reference_corner(image, at.row, at.column + 1),
                        c10 = reference_corner(image, at.row + 1, at.column),
                        c11 = reference_corner(image, at.row + 1, at.column + 1);
  const float tolerance = kReferenceDepthAgreement * at.in_camera.z;
  const auto agrees = [&](const ReferenceCorner& c) { return std::fabs(c.depth - at.in_camera.z) < tolerance; };
  if (!(agrees(c00) && agrees(c01) && agrees(c10) && agrees(c11))) return;
  const IntensityDifference difference = scaled_difference(
      bilinear_value(c00.intensity, c01.intensity, c10.intensity, c11.intensity, at.a, at.b), scale, luma(pixel.color));
  const float x = difference.by_u * image.intrinsics.fx * at.inverse_z;
  const float y = difference.by_v * image.intrinsics.fy * at.inverse_z;
  const Vec3<float> by_point{x, y, -(x * at.in_camera.x + y * at.in_camera.y) * at.inverse_z};
  const Vec3<float> slope = (lever * image.weight) * (pose.rotation * by_point);
  const T weight = static_cast<T>(robust_weight(difference.value, image.kernel));
  const float residual = image.weight * difference.value;
  add_weighted_residual(point.offset, residual, slope, weight, terms);
  add_gain_residual(point.offset, residual, slope, image.weight * difference.by_gain, weight, gain_terms);
}

}  // namespace spslam
