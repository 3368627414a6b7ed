// Reading a signed distance field on sparse blocks: trilinear interpolation, and the first surface on a ray.
#pragma once

#include <cmath>
#include <cstdint>

#include "core/macros.h"
#include "core/vec.h"
#include "kernels/tsdf.h"

namespace spslam {

// Steps on a ray before it is given up, against rays along a surface.
constexpr int kMaxRaySteps = 4096;
// Of the distance to the surface, which a step may take without missing it.
constexpr float kStepShare = 0.8f;

struct TsdfSample {
  float sdf;
  Vec3<float> color;  // [0, 1]; 0 where no voxel around has one
  bool known;
};

// A voxel's place in the arrays, or -1.
SPS_INLINE std::int64_t voxel_place(const TsdfView& view, VoxelCoord voxel) {
  constexpr int kMask = kTsdfBlockSide - 1;
  const std::int32_t block = find_voxel(view.table, {voxel.x >> 3, voxel.y >> 3, voxel.z >> 3});
  if (block < 0 || block >= view.count) return -1;
  return static_cast<std::int64_t>(kTsdfBlockVoxels) * block +
         ((voxel.x & kMask) * kTsdfBlockSide + (voxel.y & kMask)) * kTsdfBlockSide + (voxel.z & kMask);
}

SPS_INLINE TsdfSample sample_tsdf(const TsdfView& view, const Vec3<float>& world, bool with_color) {
  const Vec3<float> at = (1.0f / view.voxel_size) * world;
  const Vec3<float> base{std::floor(at.x), std::floor(at.y), std::floor(at.z)};
  constexpr float kMost = 8.0f * static_cast<float>(kVoxelCoordMax);
  TsdfSample sample{0.0f, {0.0f, 0.0f, 0.0f}, false};
  const float largest = std::fmax(std::fabs(base.x), std::fmax(std::fabs(base.y), std::fabs(base.z)));
  if (!(largest < kMost) || base.x != base.x || base.y != base.y || base.z != base.z) return sample;
  const VoxelCoord corner{static_cast<std::int32_t>(base.x), static_cast<std::int32_t>(base.y),
                          static_cast<std::int32_t>(base.z)};
  const Vec3<float> local = at - base;
  float colored = 0.0f;
  for (int c = 0; c < kCellCorners; ++c) {
    const std::int64_t place = voxel_place(view, cell_corner(corner, c));
    if (place < 0) return {0.0f, {0.0f, 0.0f, 0.0f}, false};
    // A voxel in which nothing was measured has distance 0, which is no surface.
    const float voxel_weight = view.weights[place];
    if (!(voxel_weight > 0.0f && voxel_weight >= view.min_weight)) return {0.0f, {0.0f, 0.0f, 0.0f}, false};
    const float weight = ((c & 1) ? local.x : 1.0f - local.x) * ((c & 2) ? local.y : 1.0f - local.y) *
                         ((c & 4) ? local.z : 1.0f - local.z);
    sample.sdf += weight * view.sdf[place];
    const std::uint16_t* color = view.colors + kTsdfColorSize * place;
    if (with_color && color[3] > 0) {
      const float scale = weight / (kColorUnit * 255.0f);
      sample.color = sample.color + scale * Vec3<float>{static_cast<float>(color[0]), static_cast<float>(color[1]),
                                                        static_cast<float>(color[2])};
      colored += weight;
    }
  }
  if (colored > 0.0f) sample.color = (1.0f / colored) * sample.color;
  sample.known = true;
  return sample;
}

// Gradient by central differences of half a voxel, of length 1; 0 where the field is not known around.
SPS_INLINE Vec3<float> tsdf_normal(const TsdfView& view, const Vec3<float>& world) {
  const float h = 0.5f * view.voxel_size;
  float slope[3];
  for (int a = 0; a < 3; ++a) {
    const Vec3<float> step{a == 0 ? h : 0.0f, a == 1 ? h : 0.0f, a == 2 ? h : 0.0f};
    const TsdfSample above = sample_tsdf(view, world + step, false), below = sample_tsdf(view, world - step, false);
    if (!above.known || !below.known) return {0.0f, 0.0f, 0.0f};
    slope[a] = above.sdf - below.sdf;
  }
  const Vec3<float> gradient{slope[0], slope[1], slope[2]};
  const float length = std::sqrt(dot(gradient, gradient));
  return length > 0.0f ? (1.0f / length) * gradient : gradient;
}

// Whether a row of block coordinates is a block, and not in a table.
SPS_INLINE bool is_missing_block(const VoxelTable& table, VoxelCoord block) {
  return block.x != kNoBlock && find_voxel(table, block) == kNoVoxel;
}

// Whether the block around a point exists.
SPS_INLINE bool in_block(const TsdfView& view, const Vec3<float>& world) {
  const VoxelCoord block = block_at(world, 1.0f / (kTsdfBlockSide * view.voxel_size));
  return block.x != kNoBlock && find_voxel(view.table, block) != kNoVoxel;
}

struct RayHit {
  float depth;
  Vec3<float> world;
};

// The first place on the ray origin + depth direction where the field goes from positive to negative; depth 0 for none.
SPS_INLINE RayHit cast_ray(const TsdfView& view, const Vec3<float>& origin, const Vec3<float>& direction, float near,
                           float far) {
  const float per_meter = 1.0f / std::sqrt(dot(direction, direction));  // depth per meter on the ray
  const float least = 0.5f * view.voxel_size * per_meter, skip = 2.0f * view.voxel_size * per_meter;
  float depth = near, last_depth = 0.0f, last_sdf = 0.0f;
  bool last_known = false;
  for (int n = 0; n < kMaxRaySteps && depth < far; ++n) {
    const Vec3<float> point = origin + depth * direction;
    if (!in_block(view, point)) {
      last_known = false;
      depth += skip;
      continue;
    }
    const TsdfSample sample = sample_tsdf(view, point, false);
    if (sample.known && last_known && last_sdf > 0.0f && sample.sdf <= 0.0f) {
      const float hit = last_depth + (depth - last_depth) * last_sdf / (last_sdf - sample.sdf);
      return {hit, origin + hit * direction};
    }
    last_known = sample.known;
    last_depth = depth;
    last_sdf = sample.sdf;
    const float wanted = sample.known && sample.sdf > 0.0f ? kStepShare * sample.sdf * per_meter : least;
    depth += wanted > least ? wanted : least;
  }
  return {0.0f, origin};
}

}  // namespace spslam
