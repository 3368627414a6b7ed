// The maths of a rolling shutter: the camera moves evenly while it reads a frame out (Hedborg et al. 2012), to first
// order. A point x of a row in camera axes is at the middle row's moment x + s (w x x + c), with s the time from the
// middle row to the point's, w the angular and c the linear velocity in camera axes.
#pragma once

#include <cmath>
#include <cstdint>

#include "core/macros.h"
#include "core/math.h"
#include "core/vec.h"
#include "kernels/color_pose.h"
#include "kernels/earlier_frame.h"
#include "kernels/pixel_record.h"
#include "spslam/rolling_shutter.h"

namespace spslam {

// rad, m: what moves by more during the readout has jumped.
constexpr float kMaxReadoutMotion = 0.15f;

// The velocity in camera axes (rad/s, m/s), and the readout (s); 0 where the frame is to stay as it is.
struct ReadoutMotion {
  Vec3<float> angular, linear;
  float readout;
};

SPS_INLINE Vec3<float> to_camera(const Mat3<float>& rotation, const Vec3<float>& v) {
  const float* r = rotation.m;
  return {r[0] * v.x + r[3] * v.y + r[6] * v.z, r[1] * v.x + r[4] * v.y + r[7] * v.z,
          r[2] * v.x + r[5] * v.y + r[8] * v.z};
}

SPS_INLINE ReadoutMotion readout_motion(const ShutterMotion& motion) {
  const CameraVelocity world = camera_velocity(motion.before, {0, motion.seconds, 0.0f}, motion.pose);
  const Mat3<float> rotation = load_pose(motion.pose).rotation;
  const float readout = *motion.readout, turn = readout * std::sqrt(dot(world.angular, world.angular)),
              way = readout * std::sqrt(dot(world.linear, world.linear));
  const bool moves_evenly = std::fabs(turn) < kMaxReadoutMotion && std::fabs(way) < kMaxReadoutMotion;
  return {to_camera(rotation, world.angular), to_camera(rotation, world.linear), moves_evenly ? readout : 0.0f};
}

SPS_INLINE Vec3<float> at_middle_row(const ReadoutMotion& motion, const Vec3<float>& point, float row,
                                     std::int64_t height) {
  const float s = motion.readout * row_share(row, height);
  return point + s * (cross(motion.angular, point) + motion.linear);
}

// A record at the middle row's moment: its depth and, to the nearest pixel, its place; as it was where that is off the
// image. `out` may be `words`.
SPS_INLINE void rectify_record(const ReadoutMotion& motion, const ShutterCamera& camera, const std::int32_t* words,
                               std::int32_t* out) {
  const Pixel pixel = unpack_pixel(words);
  const Intrinsics& k = camera.intrinsics;
  for (int w = 0; w < kPixelWords; ++w) out[w] = words[w];
  if (!(pixel.depth > 0.0f) || motion.readout == 0.0f) return;
  const Vec3<float> moved = at_middle_row(motion, pixel.depth * pixel_ray(pixel, k), pixel.v, camera.height);
  const float u = std::rint(moved.x / moved.z * k.fx + k.cx), v = std::rint(moved.y / moved.z * k.fy + k.cy);
  const bool inside =
      u >= 0.0f && v >= 0.0f && u < static_cast<float>(camera.width) && v < static_cast<float>(camera.height);
  if (!(moved.z > 0.0f && inside)) return;
  out[0] = static_cast<std::int32_t>(static_cast<std::uint32_t>(u) | static_cast<std::uint32_t>(v) << 16);
  __builtin_memcpy(out + 1, &moved.z, sizeof(float));
}

// m: of a feature that is rectified; nearer it stays as it was.
constexpr float kMinRectifiedDepth = 0.05f;

// An image feature at the middle row's moment: its position [2] and its point [3], 0 where the depth is unknown and
// only the turn is heeded.
SPS_INLINE void rectify_feature(const ReadoutMotion& motion, const ShutterCamera& camera, const float* position,
                                const float* point, float* out_position, float* out_point) {
  const Intrinsics& k = camera.intrinsics;
  const bool known = point[2] > 0.0f;
  const Vec3<float> ray{(position[0] - k.cx) / k.fx, (position[1] - k.cy) / k.fy, 1.0f};
  const Vec3<float> before = known ? Vec3<float>{point[0], point[1], point[2]} : ray;
  const Vec3<float> linear = known ? motion.linear : Vec3<float>{};
  Vec3<float> moved = at_middle_row({motion.angular, linear, motion.readout}, before, position[1],
                                    camera.height > 1 ? camera.height : 2);
  if (!(moved.z > kMinRectifiedDepth)) moved = before;
  out_position[0] = moved.x / moved.z * k.fx + k.cx;
  out_position[1] = moved.y / moved.z * k.fy + k.cy;
  const Vec3<float> kept = known ? moved : Vec3<float>{};
  out_point[0] = kept.x;
  out_point[1] = kept.y;
  out_point[2] = kept.z;
}

// Which pixel, as it was read, shows what a pixel is to show, in px; its depth times scale is that of the pixel.
struct ReadPixel {
  float column, row, scale;
};

// Of a pixel (u, v), by its own depth (m): the motion is alike for its neighbors. Without depth only the turn is
// heeded, as for points far away.
SPS_INLINE ReadPixel look_up(float depth, const ReadoutMotion& motion, const ShutterCamera& camera, float u, float v) {
  const Intrinsics& k = camera.intrinsics;
  const float inverse_z = depth > 0.0f ? 1.0f / depth : 0.0f;
  const Vec3<float> ray{(u - k.cx) * (1.0f / k.fx), (v - k.cy) * (1.0f / k.fy), 1.0f};
  const ReadoutMotion per_depth{motion.angular, inverse_z * motion.linear, motion.readout};
  const Vec3<float> moved = at_middle_row(per_depth, ray, v, camera.height);
  const float by_z = 1.0f / larger(moved.z, 0.5f);
  const float column = 2.0f * u - (moved.x * by_z * k.fx + k.cx), row = 2.0f * v - (moved.y * by_z * k.fy + k.cy);
  return {smaller(larger(column, 0.0f), static_cast<float>(camera.width - 1)),
          smaller(larger(row, 0.0f), static_cast<float>(camera.height - 1)), moved.z};
}

// Where that is in the images: the nearest pixel, the upper left one of four, and the place between these.
struct ReadPlace {
  std::int32_t row, column, top, left;
  float by_column, by_row;
};

SPS_INLINE ReadPlace read_place(const ShutterCamera& camera, ReadPixel from) {
  const std::int32_t left = static_cast<std::int32_t>(smaller(from.column, static_cast<float>(camera.width - 2))),
                     top = static_cast<std::int32_t>(smaller(from.row, static_cast<float>(camera.height - 2)));
  return {static_cast<std::int32_t>(from.row + 0.5f),
          static_cast<std::int32_t>(from.column + 0.5f),
          top,
          left,
          from.column - static_cast<float>(left),
          from.row - static_cast<float>(top)};
}

// Depth of the nearest pixel that was read; unknown where it would lie behind the camera.
SPS_INLINE std::uint16_t rectified_depth(float scale, float depth) {
  return static_cast<std::uint16_t>(smaller(larger(scale * depth + 0.5f, 0.0f), 65535.0f));
}

// Intensity between four pixels that were read.
SPS_INLINE std::uint8_t rectified_intensity(float v00, float v01, float v10, float v11, float by_column, float by_row) {
  return static_cast<std::uint8_t>(bilinear_value(v00, v01, v10, v11, by_column, by_row).value + 0.5f);
}

// What a pixel of the images shows at the middle row's moment.
SPS_INLINE void rectify_pixel(const FrameImages& images, const ShutterCamera& camera, const ReadPixel& from,
                              std::uint16_t* depth, std::uint8_t* intensity) {
  const ReadPlace at = read_place(camera, from);
  *depth = rectified_depth(from.scale, images.depth[at.row * camera.width + at.column]);
  const std::uint8_t* corner = images.intensity + at.top * camera.width + at.left;
  *intensity = rectified_intensity(corner[0], corner[1], corner[camera.width], corner[camera.width + 1], at.by_column,
                                   at.by_row);
}

}  // namespace spslam
