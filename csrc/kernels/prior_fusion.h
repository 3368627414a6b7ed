// The scene prior, for one element: the pair of a point and a vertex, fusion into an embedding.
#pragma once

#include <cmath>
#include <cstdint>

#include "core/macros.h"
#include "core/philox.h"
#include "core/vec.h"
#include "kernels/voxel_hash.h"
#include "spslam/prior_fusion.h"

namespace spslam {

// The vertices that a point reaches: per axis `side` of them, the first at `first` from the cell's lowest corner.
struct Neighborhood {
  int side, first;
  float reach;  // voxels at which a pair's weight falls to 0

  SPS_INLINE int corners() const { return side * side * side; }
};

SPS_INLINE Neighborhood neighborhood_of(std::int32_t corners) {
  return corners == 64 ? Neighborhood{4, -1, 2.0f} : Neighborhood{2, 0, 1.0f};
}

// A point to encode, in voxel units: its cell's lowest corner and where it lies in the cell.
struct EncodedPoint {
  VoxelCoord cell;
  Vec3<float> local;
  bool valid;
};

SPS_INLINE EncodedPoint locate_point(const float* point, const float* normal, float inverse_voxel_size) {
  constexpr int kMargin = 2;  // so that every vertex of the neighborhood is in range
  constexpr float kLow = kVoxelCoordMin + kMargin, kHigh = kVoxelCoordMax - kMargin;
  const Vec3<float> p{point[0] * inverse_voxel_size, point[1] * inverse_voxel_size, point[2] * inverse_voxel_size};
  const Vec3<float> base{std::floor(p.x), std::floor(p.y), std::floor(p.z)};
  const bool in_range =
      base.x >= kLow && base.x <= kHigh && base.y >= kLow && base.y <= kHigh && base.z >= kLow && base.z <= kHigh;
  const float length2 = normal[0] * normal[0] + normal[1] * normal[1] + normal[2] * normal[2];
  if (!in_range || !(length2 > 0.0f)) return {{0, 0, 0}, {0.0f, 0.0f, 0.0f}, false};
  return {{static_cast<std::int32_t>(base.x), static_cast<std::int32_t>(base.y), static_cast<std::int32_t>(base.z)},
          p - base,
          true};
}

// Position relative to vertex i of an axis, over the reach, in [-1, 1]: an input of the encoder.
SPS_INLINE float relative_position(const Neighborhood& neighborhood, float local, int i) {
  return (local - static_cast<float>(neighborhood.first + i)) / neighborhood.reach;
}

// prod(1 - |relative|)^3 over the axes.
SPS_INLINE float pair_weight(float x, float y, float z) {
  const float tent = (1.0f - std::fabs(x)) * (1.0f - std::fabs(y)) * (1.0f - std::fabs(z));
  return tent * tent * tent;
}

// Whether a pair is worth encoding; a weight of 0 never is.
SPS_INLINE bool pair_counts(float weight, float min_pair_weight) {
  constexpr float kSmallestNormal = 1.17549435e-38f;
  return weight >= min_pair_weight && weight >= kSmallestNormal;
}

// Sums over at most n points are kept as integers, which do not depend on the order of additions: the weight of a
// vertex is the same on every device, and so is what depends on it. Terms are below 2^headroom_bits.
SPS_INLINE float sum_scale(std::int64_t n, int headroom_bits) {
  int bits = 62 - headroom_bits;
  for (; n > 0; n >>= 1) --bits;
  return static_cast<float>(std::int64_t{1} << bits);
}

SPS_INLINE float weight_scale(std::int64_t n) {
  return sum_scale(n, 0);
}

// A weight in units of 1 / scale, rounded towards 0, but 1 at least: a sum of 0 means that there was no pair.
SPS_INLINE std::int64_t weight_units(float weight, float scale) {
  const std::int64_t units = static_cast<std::int64_t>(weight * scale);
  return units > 0 ? units : 1;
}

SPS_INLINE float weight_of_units(std::int64_t units, float scale) {
  return static_cast<float>(units) / scale;
}

// The share of a frame's features in a fusion, from the sum of their weights.
SPS_INLINE float fusion_share(float weight, float kappa) {
  const float share = weight / kappa;
  return share < 1.0f ? share : 1.0f;
}

// Equation (1) for one number of an embedding: (weight * embedding + share * feature) / (weight + share).
SPS_INLINE float fused_feature(float embedding, float weight, float feature, float share) {
  return embedding + share / (weight + share) * (feature - embedding);
}

// The weight after a fusion; it grows up to max_weight.
SPS_INLINE float fused_weight(float weight, float share, float max_weight) {
  const float total = weight + share;
  return total < max_weight ? total : max_weight;
}

// Both for a whole embedding. A feature without weight changes nothing.
SPS_INLINE void fuse_feature(const float* feature, float share, float max_weight, float* embedding, float* weight) {
  if (!(share > 0.0f)) return;
  for (int c = 0; c < kPriorFeatures; ++c) embedding[c] = fused_feature(embedding[c], *weight, feature[c], share);
  *weight = fused_weight(*weight, share, max_weight);
}

// Eight numbers from N(0, scale^2) by Box and Muller, with the coordinates as the Philox counter.
SPS_INLINE void random_embedding(std::uint64_t seed, VoxelCoord coord, float scale, float* embedding) {
  constexpr std::uint64_t kSecondHalf = 0x9E3779B97F4A7C15ull;  // a second key: one counter gives four numbers
  constexpr float kTwoPi = 6.28318531f;
  for (int half = 0; half < 2; ++half) {
    const PhiloxKey key{half == 0 ? seed : seed ^ kSecondHalf,
                        static_cast<std::uint32_t>(RandomStream::kInitialization), static_cast<std::uint32_t>(coord.z),
                        static_cast<std::uint32_t>(coord.y)};
    const Philox4 bits = philox(key, static_cast<std::uint32_t>(coord.x));
    const std::uint32_t words[4] = {bits.x, bits.y, bits.z, bits.w};
    for (int pair = 0; pair < 2; ++pair) {
      const float radius = scale * std::sqrt(-2.0f * std::log(1.0f - uniform_from_bits(words[2 * pair])));
      const float angle = kTwoPi * uniform_from_bits(words[2 * pair + 1]);
      embedding[4 * half + 2 * pair] = radius * std::cos(angle);
      embedding[4 * half + 2 * pair + 1] = radius * std::sin(angle);
    }
  }
}

}  // namespace spslam
