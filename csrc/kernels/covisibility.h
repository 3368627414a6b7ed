// Whether a frame sees a point.
// In float64, so that CPU and CUDA decide alike despite different rounding: the selection of frames must be the same on
// both.
#pragma once

#include <cmath>
#include <cstdint>

#include "core/macros.h"
#include "core/vec.h"
#include "kernels/pixel_record.h"
#include "spslam/covisibility.h"

namespace spslam {

constexpr double kMinPointDepth = 0.05;  // m
constexpr double kDepthAgreement = 0.1;  // m

SPS_INLINE Pose<double> load_frame_pose(const float* pose) {
  const double p[kPoseSize] = {pose[0], pose[1], pose[2], pose[3], pose[4], pose[5], pose[6]};
  return load_pose(p);
}

// The float of a float16's bits.
SPS_INLINE float half_to_float(std::uint16_t bits) {
  const std::uint32_t exponent = bits >> 10 & 0x1Fu, mantissa = bits & 0x3FFu;
  if (exponent == 0)
    return static_cast<float>(mantissa) * (bits & 0x8000u ? -5.9604644775390625e-8f : 5.9604644775390625e-8f);
  const std::uint32_t wide = (bits & 0x8000u) << 16 | (exponent == 31u ? 255u : exponent + 112u) << 23 | mantissa << 13;
  float value;
  __builtin_memcpy(&value, &wide, sizeof value);
  return value;
}

// World point of a packed pixel of a frame.
SPS_INLINE Vec3<double> pixel_point(const std::int32_t* record, const Pose<double>& pose, const Intrinsics& k) {
  const Pixel pixel = unpack_pixel(record);
  const double z = pixel.depth;
  const Vec3<double> local{(static_cast<double>(pixel.u) - k.cx) / k.fx * z,
                           (static_cast<double>(pixel.v) - k.cy) / k.fy * z, z};
  return pose.rotation * local + pose.translation;
}

// A world point in the axes of a frame.
SPS_INLINE Vec3<double> in_frame(const Pose<double>& pose, const Vec3<double>& point) {
  const Vec3<double> d = point - pose.translation;
  const double* r = pose.rotation.m;
  return {r[0] * d.x + r[3] * d.y + r[6] * d.z, r[1] * d.x + r[4] * d.y + r[7] * d.z,
          r[2] * d.x + r[5] * d.y + r[8] * d.z};
}

// A depth thumbnail cell holds the depth of its middle pixel; pixel u lies in cell (u + 1/2) / step, so that no pixel
// is on the border of two.
SPS_INLINE bool sees_point(const FrameThumbnails& frames, std::int64_t frame, const Pose<double>& pose,
                           const Vec3<double>& point) {
  const auto [x, y, z] = in_frame(pose, point);
  if (!(z > kMinPointDepth)) return false;
  const Intrinsics& k = frames.intrinsics;
  const double step = static_cast<double>(frames.step);
  const double column = std::floor((x / z * k.fx + k.cx + 0.5) / step);
  const double row = std::floor((y / z * k.fy + k.cy + 0.5) / step);
  if (!(column >= 0.0 && column < static_cast<double>(frames.columns) && row >= 0.0 &&
        row < static_cast<double>(frames.rows))) {
    return false;
  }
  const std::int64_t cell =
      (frame * frames.rows + static_cast<std::int64_t>(row)) * frames.columns + static_cast<std::int64_t>(column);
  const double seen = half_to_float(frames.depth_thumbnails[cell]);
  return seen > 0.0 && std::fabs(seen - z) < kDepthAgreement;
}

SPS_INLINE bool is_frame(const FrameThumbnails& frames, std::int64_t row) {
  return row >= 0 && row < frames.num_frames;
}

// Fewest of the points that a co-visible frame sees.
SPS_INLINE std::int64_t covisible_count(const CovisibleSelection& selection) {
  return static_cast<std::int64_t>(std::floor(selection.threshold * static_cast<double>(selection.num_points))) + 1;
}

}  // namespace spslam
