// The maths of integrating measured planes into blocks of signed distance: which blocks a pixel touches, what a voxel
// learns from a frame, and how its mean changes.
#pragma once

#include <cmath>
#include <cstdint>

#include "core/macros.h"
#include "core/vec.h"
#include "kernels/depth_noise.h"
#include "kernels/depth_planes.h"
#include "kernels/voxel_hash.h"
#include "spslam/tsdf.h"

namespace spslam {

constexpr float kNearestIntegrated = 0.05f;  // m
// A ray that grazes the surface is followed through the truncation as if it met it at this cosine.
constexpr float kTouchCosine = 0.3f;
// The truncation is at least so many deviations of the noise, up to the most (m). Within a shorter one the means of
// noisy depth cross 0 in many places: a far wall becomes a crumpled stack of sheets. The most bounds the blocks that it
// takes.
constexpr float kTruncationDeviations = 2.0f, kMostNoiseTruncation = 0.2f;
// Voxels from the surface up to which colors are taken.
constexpr float kColorBand = 1.5f;
constexpr float kColorUnit = 256.0f, kColorWeightUnit = 1024.0f, kMostUnits = 65535.0f;

// Where a pixel's ray meets its plane, as depth (m); 0 without a plane.
SPS_INLINE float plane_depth(const MeasuredPlane& plane, const Intrinsics& camera, float u, float v) {
  const float x = (u - camera.cx) / camera.fx, y = (v - camera.cy) / camera.fy;
  const float depth = plane.distance / (plane.normal.x * x + plane.normal.y * y + plane.normal.z);
  return plane.weight > 0.0f ? depth : 0.0f;
}

SPS_INLINE VoxelCoord block_at(const Vec3<float>& world, float inverse_block_size) {
  const float x = std::floor(world.x * inverse_block_size), y = std::floor(world.y * inverse_block_size),
              z = std::floor(world.z * inverse_block_size);
  constexpr float kLow = static_cast<float>(kVoxelCoordMin), kHigh = static_cast<float>(kVoxelCoordMax);
  const bool inside = (x >= kLow) & (y >= kLow) & (z >= kLow) & (x <= kHigh) & (y <= kHigh) & (z <= kHigh);
  // Converted only where it fits.
  const std::int32_t i = static_cast<std::int32_t>(inside ? x : 0.0f);
  return {inside ? i : kNoBlock, static_cast<std::int32_t>(inside ? y : 0.0f),
          static_cast<std::int32_t>(inside ? z : 0.0f)};
}

SPS_INLINE bool same_block(const VoxelCoord& a, const VoxelCoord& b) {
  return (a.x == b.x) & (a.y == b.y) & (a.z == b.z);
}

// The truncation (m) of depth with a deviation of the noise, at least `shortest`.
SPS_INLINE float noisy_truncation(float shortest, float deviation) {
  const float wide = kTruncationDeviations * deviation;
  const float reach = wide < kMostNoiseTruncation ? wide : kMostNoiseTruncation;
  return shortest > reach ? shortest : reach;
}

// The part of a pixel's ray within the truncation of its plane, as camera points `first` + s `step`.
struct TouchedRay {
  Vec3<float> first, step;
  bool known;
};

SPS_INLINE TouchedRay touched_ray(const MeasuredPlane& plane, const Intrinsics& camera, const TouchOptions& options,
                                  float u, float v) {
  const Vec3<float> ray{(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, 1.0f};
  const float along = plane.normal.x * ray.x + plane.normal.y * ray.y + plane.normal.z;
  const float depth = plane.distance / along;
  const float least = kTouchCosine * std::sqrt(dot(ray, ray));
  const float truncation = noisy_truncation(options.truncation, std::sqrt(depth_variance(options.noise, depth)));
  const float reach = truncation / (along > least ? along : least);
  return {(depth - reach) * ray, (2.0f * reach / (kTouchedPerPixel - 1)) * ray, plane.weight > 0.0f};
}

// The block of sample k of kTouchedPerPixel along a ray.
SPS_INLINE VoxelCoord touched_block(const Vec3<float>& first, const Vec3<float>& step, int k, const Pose<float>& pose,
                                    float inverse_block_size) {
  const Vec3<float> point = first + static_cast<float>(k) * step;
  return block_at(pose.rotation * point + pose.translation, inverse_block_size);
}

// A block in camera axes: its first voxel and the steps between voxels, m.
struct BlockInCamera {
  Vec3<float> first, i, j, k;
};

SPS_INLINE BlockInCamera block_in_camera(const Pose<float>& pose, const std::int32_t* coords, float voxel_size) {
  const float edge = kTsdfBlockSide * voxel_size;
  const float* r = pose.rotation.m;
  const Vec3<float> from = Vec3<float>{static_cast<float>(coords[0]) * edge, static_cast<float>(coords[1]) * edge,
                                       static_cast<float>(coords[2]) * edge} -
                           pose.translation;
  return {{r[0] * from.x + r[3] * from.y + r[6] * from.z, r[1] * from.x + r[4] * from.y + r[7] * from.z,
           r[2] * from.x + r[5] * from.y + r[8] * from.z},
          {voxel_size * r[0], voxel_size * r[1], voxel_size * r[2]},
          {voxel_size * r[3], voxel_size * r[4], voxel_size * r[5]},
          {voxel_size * r[6], voxel_size * r[7], voxel_size * r[8]}};
}

// First and last tile that may hold pixels of [center - radius, center + radius], of a ball `nearest` m away or more.
struct TileRange {
  int first, last;
};

SPS_INLINE TileRange tile_range(float center, float radius, float nearest, float farthest, float focal, float offset,
                                std::int32_t size) {
  const float low = center - radius, high = center + radius;
  const float first = focal * (low < 0.0f ? low / nearest : low / farthest) + offset;
  const float last = focal * (high > 0.0f ? high / nearest : high / farthest) + offset;
  if (last < -0.5f || first > static_cast<float>(size) - 0.5f) return {0, -1};
  const float end = static_cast<float>(size - 1);
  return {static_cast<int>(first > 0.0f ? first + 0.5f : 0.0f) / kTsdfTileSide,
          static_cast<int>(last < end ? last + 0.5f : end) / kTsdfTileSide};
}

// Whether a frame may say something of a block: it lies in view, and not all behind what was measured.
SPS_INLINE bool block_in_view(const PlaneFrame& frame, const BlockInCamera& block, const float* tiles_far,
                              const TsdfOptions& options) {
  constexpr float kHalf = 0.5f * (kTsdfBlockSide - 1);
  const Vec3<float> center = block.first + kHalf * (block.i + block.j + block.k);
  const float radius = kHalf * std::sqrt(3.0f * dot(block.i, block.i));
  const float farthest = center.z + radius;
  if (!(farthest > kNearestIntegrated)) return false;
  const float nearest = center.z - radius > kNearestIntegrated ? center.z - radius : kNearestIntegrated;
  const TileRange u = tile_range(center.x, radius, nearest, farthest, frame.camera.fx, frame.camera.cx, frame.width);
  const TileRange v = tile_range(center.y, radius, nearest, farthest, frame.camera.fy, frame.camera.cy, frame.height);
  float far = 0.0f;
  for (int tile_v = v.first; tile_v <= v.last; ++tile_v) {
    for (int tile_u = u.first; tile_u <= u.last; ++tile_u) {
      const float own = tiles_far[tile_v * tiles_along(frame.width) + tile_u];
      far = own > far ? own : far;
    }
  }
  // A plane is measured along its normal: where it is steep, the truncation reaches farther along the ray.
  const float deviation = std::sqrt(depth_variance(options.noise, farthest));
  return far > 0.0f && nearest < far + noisy_truncation(options.truncation, deviation) / kTouchCosine;
}

// The pixel that a point in camera axes falls on, as its place in the image; -1 for none.
SPS_INLINE std::int32_t pixel_at(const PlaneFrame& frame, const Vec3<float>& at) {
  const float inverse_z = 1.0f / (at.z > kNearestIntegrated ? at.z : kNearestIntegrated);
  const float u = frame.camera.fx * at.x * inverse_z + frame.camera.cx + 0.5f;
  const float v = frame.camera.fy * at.y * inverse_z + frame.camera.cy + 0.5f;
  const bool inside = (at.z > kNearestIntegrated) & (u >= 0.0f) & (v >= 0.0f) & (u < static_cast<float>(frame.width)) &
                      (v < static_cast<float>(frame.height));
  // Converted only where it fits.
  const float column = inside ? u : 0.0f, row = inside ? v : 0.0f;
  const std::int32_t pixel = static_cast<std::int32_t>(row) * frame.width + static_cast<std::int32_t>(column);
  return inside ? pixel : -1;
}

// Behind the surface a voxel's weight is full up to so many deviations of the noise, but no farther than this share of
// the truncation, from where on it falls to 0: what lies there may be the other side of a thin board. A weight that
// fell from the surface on would favor what lies before it, and move the surface back by more than half the variance
// over the truncation.
constexpr float kFullWeightDeviations = 1.2f, kMostFullWeight = 0.7f;

// What a voxel learns from a frame: its distance from the plane of the pixel that it falls on, at most the pixel's
// truncation; weight 0 where nothing was measured, or the voxel lies farther behind. Behind a steep plane it is not
// farther along the axis either than the blocks are touched, but for the voxels beside the plane, which its surface
// needs: at the edge of a table some pixels have a plane that is nearly parallel to the ray, near which all lies that
// they hide.
constexpr float kBesideVoxels = 3.0f;

struct TsdfObservation {
  float sdf, weight;
};

SPS_INLINE float plane_distance(const MeasuredPlane& plane, const Vec3<float>& at) {
  return plane.distance - dot(plane.normal, at);
}

// The weight of a plane for a voxel, more than its own for one that lies farther before it than the truncation. That it
// is free is no less certain where what is seen through it is far and noisy: it weighs what a plane that the truncation
// just reaches would. Else a few pixels on an edge outvote any number that see past it to a far wall.
SPS_INLINE float weight_before(float weight, float plane_distance, float along, float depth, float truncation,
                               const TsdfOptions& options) {
  constexpr float kPerCosine = 1.0f / kTouchCosine;
  const float met = depth * plane_distance / along, farthest = plane_distance * kPerCosine;
  const float seen = met < farthest ? met : farthest, nearest = depth + truncation;
  const float more =
      (kPoseVariance + depth_variance(options.noise, seen)) / (kPoseVariance + depth_variance(options.noise, nearest));
  return weight * ((along > 0.0f) & (seen > nearest) ? more : 1.0f);
}

// Of a voxel at a depth and a distance from a plane that lies `plane_distance` from the camera and has a weight.
SPS_INLINE TsdfObservation observe_voxel(float plane_distance, float plane_weight, float distance, float depth,
                                         float voxel_size, const TsdfOptions& options) {
  const float deviation = std::sqrt(depth_variance(options.noise, depth));
  const float wanted = options.near_truncation + deviation;
  const float truncation = noisy_truncation(wanted < options.truncation ? wanted : options.truncation, deviation);
  // Its depth less the plane's on its ray is -distance depth / along.
  const float along = plane_distance - distance;
  const bool close = (-kTouchCosine * distance * depth < truncation * along) | (distance > -kBesideVoxels * voxel_size);
  const bool near = (distance > -truncation) & close;
  const float noisy = kFullWeightDeviations * deviation, most = kMostFullWeight * truncation;
  const float fall = (truncation + distance) / (truncation - (noisy < most ? noisy : most));
  const float weight = weight_before(plane_weight, plane_distance, along, depth, truncation, options);
  return {distance < truncation ? distance : truncation,
          (plane_weight > 0.0f) & near ? weight * (fall < 1.0f ? fall : 1.0f) : 0.0f};
}

// The running mean of a voxel's distances; one that is not seen stays as it is.
SPS_INLINE void update_voxel(const TsdfObservation& seen, float max_weight, float& sdf, float& weight) {
  const float total = weight + seen.weight;
  const float share = total > 0.0f ? seen.weight / total : 0.0f;
  sdf += share * (seen.sdf - sdf);
  const float most = total < max_weight ? total : max_weight;
  weight = seen.weight > 0.0f ? most : weight;
}

// Colors are taken up to kColorBand voxels from the surface, however short the truncation is.
SPS_INLINE bool takes_color(float weight, float distance, float voxel_size) {
  return (weight > 0.0f) & (std::fabs(distance) < kColorBand * voxel_size);
}

SPS_INLINE std::int32_t rounded_units(float value) {
  const float bounded = value < 0.0f ? 0.0f : value < kMostUnits ? value : kMostUnits;
  return static_cast<std::int32_t>(bounded + 0.5f);
}

// A voxel's color as in memory: red, green, blue and weight.
struct ColorUnits {
  std::int32_t red, green, blue, weight;
};

// Red, green and blue of a pixel, and the weight of its plane.
struct ColorSample {
  float red, green, blue, certainty;
};

// The running mean of a voxel's colors, `resolved` being the pixels that the voxel covers. A view counts by the
// certainty of its plane, squared, as edges and slanted views blur, and by how much of the voxel a pixel covers: one
// larger than the voxel says little of it.
SPS_INLINE ColorUnits mix_colors(const ColorUnits& mean, const ColorSample& seen, float resolved) {
  const float sharpness = resolved < 1.0f ? resolved : 1.0f;
  const float added = seen.certainty * seen.certainty * sharpness * sharpness;
  const float before = static_cast<float>(mean.weight) / kColorWeightUnit, total = before + added;
  const float share = added / total;
  const float red = static_cast<float>(mean.red), green = static_cast<float>(mean.green),
              blue = static_cast<float>(mean.blue);
  const std::int32_t weight = rounded_units(kColorWeightUnit * total);
  return {rounded_units(red + share * (kColorUnit * seen.red - red)),
          rounded_units(green + share * (kColorUnit * seen.green - green)),
          rounded_units(blue + share * (kColorUnit * seen.blue - blue)), weight > 0 ? weight : 1};
}

}  // namespace spslam
