// The surface point that a pixel of a depth image shows.
#pragma once

#include "core/macros.h"
#include "core/vec.h"
#include "kernels/pixel_record.h"

namespace spslam {

struct SurfacePoint {
  Vec3<float> world;   // m
  Vec3<float> offset;  // world - camera center
};

SPS_INLINE SurfacePoint surface_point(const Pixel& pixel, const Pose<float>& pose, const Intrinsics& intrinsics) {
  const Vec3<float> offset = pose.rotation * (pixel.depth * pixel_ray(pixel, intrinsics));
  return {offset + pose.translation, offset};
}

}  // namespace spslam
