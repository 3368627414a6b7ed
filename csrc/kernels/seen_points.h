// The maths of looking for points of a surface in a frame: where they fall, what hides them, how many pixels they have.
#pragma once

#include <cmath>
#include <cstdint>

#include "core/macros.h"
#include "core/math.h"
#include "core/vec.h"
#include "kernels/depth_noise.h"
#include "spslam/seen_points.h"

namespace spslam {

constexpr float kNearestSeen = 0.05f;  // m
// A point is hidden where the surface's nearest points around its pixel lie so much before it: meters, and pixels along
// a slanted surface. It is seen from angles up to the first cosine; flatter views have next to no pixels for it. The
// slant itself is bounded by the second.
constexpr float kSeenApart = 0.004f, kSeenApartPixels = 2.0f, kLeastSeenCosine = 0.02f, kSlantedCosine = 0.15f;
// A measured depth hides what lies so much behind it: meters and deviations of the noise.
constexpr float kSeenBehind = 0.02f, kSeenBehindDeviations = 3.0f;
// A ball's outline is farther from its center's image off the axis than its radius: twice is enough without a fisheye
// lens. Of balls around the camera, up to so many radii away, the center says nothing.
constexpr float kOutlineShare = 2.0f, kAroundRadii = 5.0f;
// Of the depth buffer where no point falls.
constexpr float kNothingDrawn = 3.0e38f;

// Columns of the depth buffer, which has a border of one pixel.
SPS_INLINE std::int64_t drawn_stride(const SeenFrame& frame) {
  return std::int64_t{frame.width} + 2;
}

SPS_INLINE Vec3<float> in_camera(const Pose<float>& pose, const Vec3<float>& world) {
  const float* r = pose.rotation.m;
  const Vec3<float> from = world - pose.translation;
  return {r[0] * from.x + r[3] * from.y + r[6] * from.z, r[1] * from.x + r[4] * from.y + r[7] * from.z,
          r[2] * from.x + r[5] * from.y + r[8] * from.z};
}

// Where a point falls: pixel coordinates and depth, m. Of points behind the camera u and v say nothing.
struct SeenPlace {
  float u, v, z;
};

SPS_INLINE SeenPlace seen_place(const SeenFrame& frame, const Pose<float>& pose, const Vec3<float>& world) {
  const Vec3<float> at = in_camera(pose, world);
  const float inverse_z = 1.0f / (at.z > kNearestSeen ? at.z : kNearestSeen);
  return {frame.camera.fx * at.x * inverse_z + frame.camera.cx, frame.camera.fy * at.y * inverse_z + frame.camera.cy,
          at.z};
}

// The nearest pixel's place in an image with `stride` columns; -1 where a point does not fall into the frame.
SPS_INLINE std::int32_t nearest_pixel(const SeenFrame& frame, float u, float v, float z, std::int32_t stride) {
  const float right = static_cast<float>(frame.width - 1), bottom = static_cast<float>(frame.height - 1);
  const bool inside =
      (z > kNearestSeen) & (z < kNothingDrawn) & (u >= 0.0f) & (v >= 0.0f) & (u <= right) & (v <= bottom);
  // Converted only where it fits.
  const float column = inside ? u + 0.5f : 0.0f, row = inside ? v + 0.5f : 0.0f;
  const std::int32_t pixel = static_cast<std::int32_t>(row) * stride + static_cast<std::int32_t>(column);
  return inside ? pixel : -1;
}

// Whether a ball (center, radius) reaches into the field of view; true of what is not finite.
SPS_INLINE bool sphere_in_view(const SeenFrame& frame, const Pose<float>& pose, const float* sphere) {
  const Vec3<float> at = in_camera(pose, {sphere[0], sphere[1], sphere[2]});
  const float radius = sphere[3], nearest = larger(at.z - radius, kNearestSeen);
  const float scale = 1.0f / larger(at.z, kNearestSeen);
  const float u = frame.camera.fx * at.x * scale + frame.camera.cx;
  const float v = frame.camera.fy * at.y * scale + frame.camera.cy;
  const float across = kOutlineShare * radius / nearest * frame.camera.fx;
  const float down = kOutlineShare * radius / nearest * frame.camera.fy;
  const bool outside = (u <= -across) | (u >= static_cast<float>(frame.width) + across) | (v <= -down) |
                       (v >= static_cast<float>(frame.height) + down);
  return !((at.z + radius <= kNearestSeen) | (outside & (at.z >= kAroundRadii * radius)));
}

// The least and the most of the 3 x 3 numbers around one in a buffer with so many columns. Points' depths are drawn
// into a depth buffer; what is nearer than its neighbors hides what lies between them: of the least ones the most, an
// erosion and a dilation of what is far.
SPS_INLINE float least_of_three(const float* at) {
  return smaller(at[-1], smaller(at[0], at[1]));
}
SPS_INLINE float most_of_three(const float* at) {
  return larger(at[-1], larger(at[0], at[1]));
}
SPS_INLINE float least_around(const float* at, std::int64_t columns) {
  return smaller(least_of_three(at - columns), smaller(least_of_three(at), least_of_three(at + columns)));
}
SPS_INLINE float most_around(const float* at, std::int64_t columns) {
  return larger(most_of_three(at - columns), larger(most_of_three(at), most_of_three(at + columns)));
}

// Cosine of the angle between a point's normal and the way to the camera.
SPS_INLINE float seen_cosine(const Pose<float>& pose, const Vec3<float>& world, const Vec3<float>& normal) {
  const Vec3<float> ray = world - pose.translation;
  return -dot(ray, normal) / std::sqrt(dot(ray, ray));
}

// Pixels per area of surface (1/m^2) of a point in the image, 0 where something hides it: other points, `front` being
// the depth of the nearest ones, or the depth that was measured. Depth that was measured behind a point does not hide
// it, nor does unknown depth: the colors that a frame has there are those that the surface is seen with.
SPS_INLINE float seen_weight(const SeenFrame& frame, float z, float cosine, float front, float measured) {
  const float pixel = z * (2.0f / (frame.camera.fx + frame.camera.fy));
  const float bounded = cosine < kSlantedCosine ? kSlantedCosine : cosine < 1.0f ? cosine : 1.0f;
  const float slope = pixel * std::sqrt(1.0f - bounded * bounded) / bounded;
  const float deviation = std::sqrt(depth_variance(frame.noise, z));
  const bool hidden = (measured > 0.0f) & (z > measured + kSeenBehind + kSeenBehindDeviations * deviation + slope);
  const bool first = z < front + kSeenApart + kSeenApartPixels * slope;
  return first & (cosine > kLeastSeenCosine) & !hidden ? cosine / (pixel * pixel) : 0.0f;
}

// The color of an image [height, width, 3] at a place in it, bilinear, rounded.
SPS_INLINE void seen_color(const SeenFrame& frame, float u, float v, std::uint8_t* color) {
  const std::int32_t column = static_cast<std::int32_t>(u), row = static_cast<std::int32_t>(v);
  const float across = u - static_cast<float>(column), down = v - static_cast<float>(row);
  const std::int64_t right = column + 1 < frame.width ? 3 : 0, below = row + 1 < frame.height ? 3 * frame.width : 0;
  const std::uint8_t* at = frame.colors + 3 * (std::int64_t{row} * frame.width + column);
  for (int c = 0; c < 3; ++c) {
    const float a = at[c], b = at[right + c], d = at[below + c], e = at[below + right + c];
    const float upper = a + across * (b - a), lower = d + across * (e - d);
    color[c] = static_cast<std::uint8_t>(upper + down * (lower - upper) + 0.5f);
  }
}

// Adds a weighted color to a point's sums.
SPS_INLINE void add_seen_color(const std::uint8_t* color, float weight, float* sums) {
  for (int c = 0; c < 3; ++c) sums[c] += weight * static_cast<float>(color[c]);
  sums[3] += weight;
}

// Adds the difference between the colors in the middle and at the ends of edge e, where all three are seen.
SPS_INLINE void add_edge_detail(const std::uint8_t* colors, const float* weights, const SeenEdges& edges,
                                std::int64_t e, float* sums) {
  const std::int64_t middle = edges.first_middle + e;
  if (!(weights[middle] > 0.0f)) return;
  const std::int64_t first = edges.ends[2 * e], second = edges.ends[2 * e + 1];
  const bool known = (first >= 0) & (second >= 0) & (first < edges.first_middle) & (second < edges.first_middle);
  if (!known || !((weights[first] > 0.0f) & (weights[second] > 0.0f))) return;
  float square = 0.0f;
  for (int c = 0; c < 3; ++c) {
    const float ends = static_cast<float>(colors[3 * first + c]) + static_cast<float>(colors[3 * second + c]);
    const float off = static_cast<float>(colors[3 * middle + c]) - 0.5f * ends;
    sums[5 * e + c] += off;
    square += off * off;
  }
  sums[5 * e + 3] += square;
  sums[5 * e + 4] += 1.0f;
}

}  // namespace spslam
