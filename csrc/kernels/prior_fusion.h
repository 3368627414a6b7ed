// The scene prior, for one element: the normal of a pixel, the pair of a point and a vertex, fusion into an embedding.
#pragma once

#include <cmath>
#include <cstdint>

#include "core/macros.h"
#include "core/philox.h"
#include "core/vec.h"
#include "kernels/voxel_hash.h"
#include "spslam/prior_fusion.h"

namespace spslam {

// Depth smoothed over a 5x5 window: Gaussian of 2 px in the image, Tukey's biweight in depth. It is as curved at 0 as a
// Gaussian of 3 cm and, unlike it, exactly 0 beyond 6 cm. 0 where the pixel is invalid.
SPS_INLINE float smoothed_depth(const DepthImage& image, std::int32_t u, std::int32_t v) {
  constexpr int kRadius = 2;
  constexpr float kSpatial[kRadius + 1] = {1.0f, 0.8824969f, 0.6065307f};
  constexpr float kInverseRange2 = 1.0f / (0.06f * 0.06f);
  const float center = image.depth[static_cast<std::int64_t>(v) * image.width + u];
  if (!(center > 0.0f)) return 0.0f;
  float weights = 0.0f, differences = 0.0f;
  for (int dv = -kRadius; dv <= kRadius; ++dv) {
    if (v + dv < 0 || v + dv >= image.height) continue;
    const float* row = image.depth + static_cast<std::int64_t>(v + dv) * image.width;
    const float row_weight = kSpatial[dv < 0 ? -dv : dv];
    for (int du = -kRadius; du <= kRadius; ++du) {
      if (u + du < 0 || u + du >= image.width) continue;
      const float z = row[u + du];
      const float difference = z - center;
      const float closeness = 1.0f - difference * difference * kInverseRange2;
      if (!(closeness > 0.0f && z > 0.0f)) continue;
      const float weight = closeness * closeness * row_weight * kSpatial[du < 0 ? -du : du];
      weights += weight;
      differences += weight * difference;
    }
  }
  return center + differences / weights;
}

SPS_INLINE Vec3<float> unproject(const DepthImage& image, std::int32_t u, std::int32_t v, float z) {
  return {(static_cast<float>(u) - image.cx) / image.fx * z, (static_cast<float>(v) - image.cy) / image.fy * z, z};
}

// Normal of the surface at a pixel from central differences over step_px; 0 at the image's border, at invalid pixels
// and where a neighbour's depth differs by max_jump of the pixel's or more.
SPS_INLINE Vec3<float> depth_normal(const DepthImage& image, std::int32_t u, std::int32_t v, std::int32_t step_px,
                                    float max_jump) {
  const Vec3<float> unknown{0.0f, 0.0f, 0.0f};
  if (u < step_px || v < step_px || u >= image.width - step_px || v >= image.height - step_px) return unknown;
  const float z = smoothed_depth(image, u, v);
  const float left = smoothed_depth(image, u - step_px, v), right = smoothed_depth(image, u + step_px, v);
  const float up = smoothed_depth(image, u, v - step_px), down = smoothed_depth(image, u, v + step_px);
  if (!(z > 0.0f && left > 0.0f && right > 0.0f && up > 0.0f && down > 0.0f)) return unknown;
  const float jump = std::fmax(std::fmax(std::fabs(left - z), std::fabs(right - z)),
                               std::fmax(std::fabs(up - z), std::fabs(down - z)));
  if (!(jump < max_jump * z)) return unknown;
  const Vec3<float> horizontal = unproject(image, u + step_px, v, right) - unproject(image, u - step_px, v, left);
  const Vec3<float> vertical = unproject(image, u, v + step_px, down) - unproject(image, u, v - step_px, up);
  const Vec3<float> normal = cross(horizontal, vertical);
  const float length = std::sqrt(dot(normal, normal));
  if (!(length > 0.0f)) return unknown;
  const float side = dot(normal, unproject(image, u, v, z)) > 0.0f ? -1.0f : 1.0f;
  return (side / length) * normal;
}

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
  constexpr int kMargin = 2;  // so that every vertex of the neighbourhood is in range
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

// The encoder's features of one pair: relative position and normal -> 64 -> 64 -> 8, ReLU inside.
SPS_INLINE void encode_pair(const float* params, const float (&input)[kEncoderInputs],
                            float (&features)[kPriorFeatures]) {
  const float* w1 = params;
  const float* b1 = w1 + kEncoderHidden * kEncoderInputs;
  const float* w2 = b1 + kEncoderHidden;
  const float* b2 = w2 + kEncoderHidden * kEncoderHidden;
  const float* w3 = b2 + kEncoderHidden;
  const float* b3 = w3 + kPriorFeatures * kEncoderHidden;
  float hidden[kEncoderHidden];
  for (int o = 0; o < kEncoderHidden; ++o) {
    float sum = b1[o];
    for (int i = 0; i < kEncoderInputs; ++i) sum += w1[o * kEncoderInputs + i] * input[i];
    hidden[o] = sum < 0.0f ? 0.0f : sum;
  }
  for (int c = 0; c < kPriorFeatures; ++c) features[c] = b3[c];
  for (int o = 0; o < kEncoderHidden; ++o) {
    float sum = b2[o];
    for (int i = 0; i < kEncoderHidden; ++i) sum += w2[o * kEncoderHidden + i] * hidden[i];
    const float unit = sum < 0.0f ? 0.0f : sum;
    for (int c = 0; c < kPriorFeatures; ++c) features[c] += w3[c * kEncoderHidden + o] * unit;
  }
}

// embedding = (weight * embedding + feature_weight * feature) / (weight + feature_weight), then the weight grows up to
// max_weight. A feature without weight changes nothing.
SPS_INLINE void fuse_feature(const float* feature, float feature_weight, float max_weight, float* embedding,
                             float* weight) {
  if (!(feature_weight > 0.0f)) return;
  const float total = *weight + feature_weight;
  const float share = feature_weight / total;
  for (int c = 0; c < kPriorFeatures; ++c) embedding[c] += share * (feature[c] - embedding[c]);
  *weight = total < max_weight ? total : max_weight;
}

// Eight numbers from N(0, scale^2) by Box and Muller, with the coordinates as the Philox counter.
SPS_INLINE void random_embedding(std::uint64_t seed, VoxelCoord coord, float scale, float* embedding) {
  constexpr std::uint64_t kSecondHalf = 0x9E3779B97F4A7C15ull;  // a second key: one counter gives four numbers
  constexpr float kTwoPi = 6.28318531f;
  for (int half = 0; half < 2; ++half) {
    const PhiloxKey key{half == 0 ? seed : seed ^ kSecondHalf, static_cast<std::uint32_t>(Stream::kInitialization),
                        static_cast<std::uint32_t>(coord.z), static_cast<std::uint32_t>(coord.y)};
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
