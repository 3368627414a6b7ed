// The maths of direct alignment: what a surface point should look like in an earlier frame's small gray image, against
// what it looks like now.
#pragma once

#include <cmath>
#include <cstdint>

#include "core/macros.h"
#include "core/vec.h"
#include "kernels/earlier_frame.h"
#include "kernels/gauss_newton.h"
#include "kernels/pixel_record.h"
#include "spslam/gauss_newton.h"

namespace spslam {

// A point is held against a cell of the reference only if their depths agree to this share: else one hides the other.
constexpr float kReferenceDepthAgreement = 0.1f;

// The reference with its pose read.
struct ReferenceView {
  ReferenceImage image;
  Pose<float> pose;
};

SPS_INLINE ReferenceView load_reference(const ReferenceImage& image) {
  return {image, image.height > 0 ? load_pose(image.pose) : Pose<float>{}};
}

// Intensity of a color in [0, 1].
SPS_INLINE float luma(const float* color) {
  constexpr float kRed = kLumaWeights[0] / 1000.0f, kGreen = kLumaWeights[1] / 1000.0f,
                  kBlue = kLumaWeights[2] / 1000.0f;
  return kRed * color[0] + kGreen * color[1] + kBlue * color[2];
}

struct ReferenceCorner {
  float intensity, depth;
};

SPS_INLINE ReferenceCorner reference_corner(const ReferenceImage& image, std::int64_t row, std::int64_t column) {
  const float* cell = image.cells + 2 * (row * image.width + column);
  return {cell[0], cell[1]};
}

// Adds the difference between the reference's intensity where the world point falls and the pixel's own, in units of
// `weight` m, to hessian and gradient (terms of type T); the cost is the surface's alone. Nothing where the point falls
// off the image, or on a cell without depth or of another depth.
template <class T>
SPS_INLINE void add_intensity_residual(const ReferenceView& reference, const Pixel& pixel, const Vec3<float>& world,
                                       const Vec3<float>& offset, T* terms) {
  const ReferenceImage& image = reference.image;
  if (!(pixel.depth > 0.0f)) return;
  const FramePlace place = place_in_frame(reference.pose, image.intrinsics, image.height, image.width, world);
  if (!place.inside) return;
  const Vec3<float>& seen = place.seen;
  const ReferenceCorner c00 = reference_corner(image, place.row, place.column),
                        c01 = reference_corner(image, place.row, place.column + 1),
                        c10 = reference_corner(image, place.row + 1, place.column),
                        c11 = reference_corner(image, place.row + 1, place.column + 1);
  const float tolerance = kReferenceDepthAgreement * seen.z;
  const auto agrees = [&](const ReferenceCorner& c) { return std::fabs(c.depth - seen.z) < tolerance; };
  if (!(agrees(c00) && agrees(c01) && agrees(c10) && agrees(c11))) return;
  const BilinearValue intensity =
      bilinear_value(c00.intensity, c01.intensity, c10.intensity, c11.intensity, place.a, place.b);
  const float difference = intensity.value - luma(pixel.color);
  const float x = intensity.by_u * image.intrinsics.fx * place.inverse_z;
  const float y = intensity.by_v * image.intrinsics.fy * place.inverse_z;
  const Vec3<float> by_seen{x, y, -(x * seen.x + y * seen.y) * place.inverse_z};
  const Vec3<float> slope = image.weight * (reference.pose.rotation * by_seen);
  add_weighted_residual(offset, image.weight * difference, slope,
                        static_cast<T>(robust_weight(difference, image.kernel)), terms);
}

}  // namespace spslam
