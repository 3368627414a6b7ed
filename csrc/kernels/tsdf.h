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
// Colors are taken up to so many voxels from the surface.
constexpr float kColorBand = 1.5f;
constexpr float kColorUnit = 256.0f, kColorWeightUnit = 1024.0f, kMostUnits = 65535.0f;

SPS_INLINE float plane_depth(const PlaneFrame& frame, const float* plane, int u, int v) {
  const float x = (static_cast<float>(u) - frame.camera.cx) / frame.camera.fx;
  const float y = (static_cast<float>(v) - frame.camera.cy) / frame.camera.fy;
  return plane[3] / (plane[0] * x + plane[1] * y + plane[2]);
}

SPS_INLINE VoxelCoord block_at(const Vec3<float>& world, float inverse_block_size) {
  const float x = std::floor(world.x * inverse_block_size), y = std::floor(world.y * inverse_block_size),
              z = std::floor(world.z * inverse_block_size);
  constexpr float kLow = static_cast<float>(kVoxelCoordMin), kHigh = static_cast<float>(kVoxelCoordMax);
  const bool inside = x >= kLow && y >= kLow && z >= kLow && x <= kHigh && y <= kHigh && z <= kHigh;
  if (!inside) return {kNoBlock, 0, 0};
  return {static_cast<std::int32_t>(x), static_cast<std::int32_t>(y), static_cast<std::int32_t>(z)};
}

// The part of a pixel's ray within the truncation of its plane, as camera points `first` + s `step`; count 0 for none.
struct TouchedRay {
  Vec3<float> first, step;
  int count;
};

SPS_INLINE TouchedRay touched_ray(const PlaneFrame& frame, float truncation, int u, int v) {
  const float* plane = frame.planes + kPlaneSize * (static_cast<std::int64_t>(v) * frame.width + u);
  if (!(plane[4] > 0.0f)) return {{0, 0, 0}, {0, 0, 0}, 0};
  const Vec3<float> ray{(static_cast<float>(u) - frame.camera.cx) / frame.camera.fx,
                        (static_cast<float>(v) - frame.camera.cy) / frame.camera.fy, 1.0f};
  const float along = plane[0] * ray.x + plane[1] * ray.y + plane[2], depth = plane[3] / along;
  const float least = kTouchCosine * std::sqrt(dot(ray, ray));
  const float reach = truncation / (along > least ? along : least);
  return {(depth - reach) * ray, (2.0f * reach / (kTouchedPerPixel - 1)) * ray, kTouchedPerPixel};
}

// Writes the blocks that a pixel touches, but those that its left neighbor's same sample touches too.
SPS_INLINE void write_touched(const PlaneFrame& frame, const Pose<float>& pose, float inverse_block_size,
                              float truncation, int u, int v, int step, std::int32_t* coords) {
  const TouchedRay own = touched_ray(frame, truncation, u, v);
  const TouchedRay left = u >= step ? touched_ray(frame, truncation, u - step, v) : TouchedRay{{0, 0, 0}, {0, 0, 0}, 0};
  const auto block = [&](const TouchedRay& ray, int k) {
    const Vec3<float> point = ray.first + static_cast<float>(k) * ray.step;
    return block_at(pose.rotation * point + pose.translation, inverse_block_size);
  };
  VoxelCoord before{kNoBlock, 0, 0};
  for (int k = 0; k < kTouchedPerPixel; ++k) {
    VoxelCoord at{kNoBlock, 0, 0};
    if (k < own.count) {
      at = block(own, k);
      const VoxelCoord beside = k < left.count ? block(left, k) : VoxelCoord{kNoBlock, 0, 0};
      const bool known = (at.x == before.x && at.y == before.y && at.z == before.z) ||
                         (at.x == beside.x && at.y == beside.y && at.z == beside.z);
      before = at;
      if (known) at.x = kNoBlock;
    }
    coords[3 * k] = at.x;
    coords[3 * k + 1] = at.x == kNoBlock ? 0 : at.y;
    coords[3 * k + 2] = at.x == kNoBlock ? 0 : at.z;
  }
}

// The farthest surface (m) in a tile of the image; 0 without any.
SPS_INLINE float tile_far(const PlaneFrame& frame, int tile_u, int tile_v) {
  float far = 0.0f;
  for (int v = tile_v * kTsdfTileSide; v < (tile_v + 1) * kTsdfTileSide && v < frame.height; ++v) {
    for (int u = tile_u * kTsdfTileSide; u < (tile_u + 1) * kTsdfTileSide && u < frame.width; ++u) {
      const float* plane = frame.planes + kPlaneSize * (static_cast<std::int64_t>(v) * frame.width + u);
      const float depth = plane[4] > 0.0f ? plane_depth(frame, plane, u, v) : 0.0f;
      far = depth > far ? depth : far;
    }
  }
  return far;
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
                              float truncation) {
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
  return far > 0.0f && nearest < far + truncation / kTouchCosine;
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
// truncation; weight 0 where nothing was measured, or the voxel lies farther behind.
struct TsdfObservation {
  float sdf, weight;
  std::int32_t pixel;
};

SPS_INLINE TsdfObservation observe_voxel(const MeasuredPlane& plane, const Vec3<float>& at, const TsdfOptions& options,
                                         std::int32_t pixel) {
  const float deviation = std::sqrt(depth_variance(options.noise, at.z));
  const float wanted = options.near_truncation + deviation;
  const float truncation = wanted < options.truncation ? wanted : options.truncation;
  const float sdf = plane.distance - dot(plane.normal, at);
  const bool known = (plane.weight > 0.0f) & (sdf > -truncation);
  const float noisy = kFullWeightDeviations * deviation / truncation;
  const float full = noisy < kMostFullWeight ? noisy : kMostFullWeight;
  const float fall = (1.0f + sdf / truncation) / (1.0f - full);
  const float weight = plane.weight * (fall < 1.0f ? fall : 1.0f);
  return {sdf < truncation ? sdf : truncation, known ? weight : 0.0f, pixel};
}

// The running mean of a voxel's distances.
SPS_INLINE void update_voxel(const TsdfObservation& seen, float max_weight, float& sdf, float& weight) {
  const float total = weight + seen.weight;
  const float share = total > 0.0f ? seen.weight / total : 0.0f;
  sdf += share * (seen.sdf - sdf);
  weight = total < max_weight ? total : max_weight;
}

SPS_INLINE std::uint16_t rounded_units(float value) {
  const float bounded = value < 0.0f ? 0.0f : value < kMostUnits ? value : kMostUnits;
  return static_cast<std::uint16_t>(bounded + 0.5f);
}

// The running mean of a voxel's colors. A view counts by the certainty of its plane, squared, as edges and slanted
// views blur, and by how much of the voxel a pixel covers: one larger than the voxel says little of it.
SPS_INLINE void update_color(const PlaneFrame& frame, const TsdfObservation& seen, float depth, float voxel_size,
                             std::uint16_t* color) {
  const float certainty = frame.planes[kPlaneSize * seen.pixel + 4];
  const float resolved = frame.camera.fx * voxel_size / depth;
  const float sharpness = resolved < 1.0f ? resolved : 1.0f;
  const float added = certainty * certainty * sharpness * sharpness;
  const float before = static_cast<float>(color[3]) / kColorWeightUnit, total = before + added;
  const float share = added / total;
  const std::uint8_t* rgb = frame.colors + 3 * static_cast<std::int64_t>(seen.pixel);
  for (int c = 0; c < 3; ++c) {
    const float old = static_cast<float>(color[c]);
    color[c] = rounded_units(old + share * (kColorUnit * static_cast<float>(rgb[c]) - old));
  }
  const std::uint16_t units = rounded_units(kColorWeightUnit * total);
  color[3] = units > 0 ? units : 1;
}

SPS_INLINE bool takes_color(const PlaneFrame& frame, const TsdfObservation& seen, float voxel_size) {
  return frame.colors != nullptr && seen.weight > 0.0f && std::fabs(seen.sdf) < kColorBand * voxel_size;
}

}  // namespace spslam
