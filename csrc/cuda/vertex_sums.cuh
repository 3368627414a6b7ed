// Encoded points summed over the voxel vertices around them: integer sums in blocks of 4 x 4 x 4 vertices, which a
// scratch hash table finds.
// Integer sums do not depend on the order of additions, so the points need not be sorted; and a point's 64 vertices lie
// in at most eight blocks, so it takes eight look-ups. Pairs of a point and a vertex are listed first, without the
// negligible ones, and then encoded: every lane of a tensor core has work.
#pragma once

#include <cstddef>
#include <cstdint>

#include "core/device.h"
#include "kernels/prior_fusion.h"
#include "kernels/voxel_hash.h"
#include "spslam/prior_fusion.h"

namespace spslam {

// Features beyond this size count as a broken network: all features of the call are then NaN.
constexpr float kLargestFeature = 32768.0f;
constexpr int kLargestFeatureBits = 15;

constexpr int kBlockSideBits = 2;
constexpr int kBlockSide = 1 << kBlockSideBits;
constexpr int kBlockVertices = kBlockSide * kBlockSide * kBlockSide;
constexpr int kBoundsRows = 128;

// What a call counts, and all that the host reads back.
struct SumCounters {
  std::uint32_t pairs, blocks, listed, found;
  std::uint32_t overflow;        // the table was too small: all but this and the bounds is undefined
  std::uint32_t poisoned;        // a feature was too large or not finite
  float bounds[kBoundsRows][6];  // of some finite points the least x, y, z, -x, -y and -z
};

// A pair that counts: of point pair / neighborhood, and of the vertex at vertex % 64 in the block of slot vertex / 64.
struct PointPair {
  std::uint32_t vertex, pair;
};

// The arrays of one call, on the device. A vertex's number is 64 times its block's, plus its place therein.
struct VertexSums {
  SumCounters* counters;
  unsigned long long* keys;      // [slots], packed block coordinates plus one; 0 is empty
  std::int32_t* blocks;          // [slots], number of the block
  std::int64_t* block_keys;      // [max_blocks], packed block coordinates
  unsigned long long* features;  // [max_blocks, 64, 8], units of 1 / feature_scale
  unsigned long long* weights;   // [max_blocks, 64], units of 1 / weight_scale; 0 where no pair reaches the vertex
  // Lists of vertices for what follows, [max_blocks, 64]: those that a volume lacks, and those that it has.
  unsigned long long* listed_keys;
  std::int32_t *listed, *found, *found_ids;
  PointPair* pairs;      // [points * neighborhood]
  std::uint32_t* known;  // one bit for each point: it has a normal
  std::int64_t slots, max_blocks;
  float feature_scale, weight_scale;
};

// Lays the arrays out from `workspace` on and says how many bytes they take. The number of blocks is an estimate,
// sixteen times as many on each further attempt, and at most eight per point, which always suffice.
VertexSums lay_out_sums(void* workspace, std::int64_t n, std::int64_t max_points, std::int32_t neighborhood,
                        int attempt, std::size_t* bytes);

// Sums over the first max_points points that have a normal. Does not wait.
void sum_over_vertices(Cuda device, const VertexSums& sums, const float* points, const float* normals, std::int64_t n,
                       std::int64_t max_points, const float* params, const EncoderSettings& settings);

// The second half of that: encodes the pairs that are listed.
void encode_listed_pairs(Cuda device, const VertexSums& sums, const float* points, const float* normals,
                         const float* params, const EncoderSettings& settings);

// Waits for the device and returns the counters.
SumCounters read_counters(Cuda device, const VertexSums& sums);

#if defined(__CUDACC__)
// A pair of a point and a vertex, as the encoder takes it.
struct EncoderInput {
  float position[3];
  float weight;
};

__device__ inline EncoderInput encoder_input(const Neighborhood& neighborhood, const EncodedPoint& point, int x, int y,
                                             int z) {
  EncoderInput input;
  input.position[0] = relative_position(neighborhood, point.local.x, x);
  input.position[1] = relative_position(neighborhood, point.local.y, y);
  input.position[2] = relative_position(neighborhood, point.local.z, z);
  input.weight = pair_weight(input.position[0], input.position[1], input.position[2]);
  return input;
}

// How far to the right a corner's number is shifted for its place along x and y; the neighborhood's sides are 4 or 2.
__device__ inline int side_bits(const Neighborhood& neighborhood) {
  return neighborhood.side == 4 ? 2 : 1;
}

__device__ inline std::int64_t num_vertices(const VertexSums& sums) {
  return sums.counters->overflow ? 0 : static_cast<std::int64_t>(sums.counters->blocks) * kBlockVertices;
}

__device__ inline std::int64_t vertex_key(const VertexSums& sums, std::int64_t vertex) {
  const VoxelCoord block = unpack_voxel(sums.block_keys[vertex / kBlockVertices]);
  const int place = static_cast<int>(vertex % kBlockVertices);
  return pack_voxel({block.x * kBlockSide + place / (kBlockSide * kBlockSide),
                     block.y * kBlockSide + place / kBlockSide % kBlockSide,
                     block.z * kBlockSide + place % kBlockSide});
}

__device__ inline float vertex_weight(const VertexSums& sums, std::int64_t vertex) {
  return weight_of_units(static_cast<std::int64_t>(sums.weights[vertex]), sums.weight_scale);
}

// One number of the weighted mean of a vertex's features.
__device__ inline float vertex_feature(const VertexSums& sums, std::int64_t vertex, int channel, float weight) {
  if (sums.counters->poisoned) return __int_as_float(0x7fffffff);
  const long long units = static_cast<long long>(sums.features[kPriorFeatures * vertex + channel]);
  return static_cast<float>(units) / sums.feature_scale / weight;
}

// A place in a list for each lane of a whole warp that wants one.
__device__ inline std::uint32_t list_place(bool wanted, std::uint32_t* count) {
  const std::uint32_t all = __ballot_sync(0xffffffffu, wanted);
  const int lane = threadIdx.x % 32;
  std::uint32_t first = 0;
  if (lane == 0 && all != 0) first = atomicAdd(count, static_cast<std::uint32_t>(__popc(all)));
  return __shfl_sync(0xffffffffu, first, 0) + __popc(all & ((1u << lane) - 1u));
}

__device__ inline void list_vertex(const VertexSums& sums, bool wanted, std::int64_t key, std::int64_t vertex) {
  const std::uint32_t place = list_place(wanted, &sums.counters->listed);
  if (!wanted) return;
  sums.listed_keys[place] = static_cast<unsigned long long>(key);
  sums.listed[place] = static_cast<std::int32_t>(vertex);
}
#endif

}  // namespace spslam
