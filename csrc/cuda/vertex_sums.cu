#include <algorithm>
#include <limits>
#include <stdexcept>
#include <type_traits>

#include "core/cuda_check.cuh"
#include "cuda/vertex_sums.cuh"
#include "kernels/voxel_hash.h"
#include "launch/workspace.h"

namespace spslam {
namespace {

constexpr int kWarpSize = 32;
constexpr unsigned kWholeWarp = 0xffffffffu;
constexpr int kThreads = 256, kWarps = kThreads / kWarpSize;
constexpr int kPointsPerBlock = kWarpSize;  // whose bits are one word
constexpr int kPointsPerWarp = kPointsPerBlock / kWarps;
constexpr int kBlocksPerPoint = 8;  // of vertices, at most
constexpr int kPairsPerThread = 8;
constexpr int kMaxProbes = 1024;  // a longer search means that the table is more than half full
static_assert(kPointsPerWarp * kBlocksPerPoint == kWarpSize, "a lane for each block of vertices");

constexpr float kInfinity = std::numeric_limits<float>::infinity();

__device__ bool is_finite(float x) {
  return fabsf(x) <= 3.40282347e38f;
}

// Empties the table, marks points that have a normal, and finds the bounds of the finite ones, one row per block.
__global__ void __launch_bounds__(kThreads)
    prepare_points(VertexSums sums, const float* points, const float* normals, std::int64_t n) {
  const std::int64_t thread = blockIdx.x * static_cast<std::int64_t>(kThreads) + threadIdx.x;
  const std::int64_t stride = static_cast<std::int64_t>(gridDim.x) * kThreads;
  for (std::int64_t i = thread; i < sums.slots; i += stride) sums.keys[i] = 0;
  SumCounters& counters = *sums.counters;
  if (thread == 0) {
    counters.pairs = counters.blocks = counters.listed = counters.found = 0;
    counters.overflow = counters.poisoned = 0;
  }
  for (std::int64_t i = 6 * gridDim.x + thread; i < 6 * kBoundsRows; i += stride) {
    counters.bounds[i / 6][i % 6] = kInfinity;
  }
  float extremes[6];
  for (float& extreme : extremes) extreme = kInfinity;
  const std::int64_t words = (n + kWarpSize - 1) / kWarpSize;
  for (std::int64_t i = thread; i < words * kWarpSize; i += stride) {
    bool known = false;
    if (i < n) {
      known = normals[3 * i] != 0.0f || normals[3 * i + 1] != 0.0f || normals[3 * i + 2] != 0.0f;
      const float p[3] = {points[3 * i], points[3 * i + 1], points[3 * i + 2]};
      if (is_finite(p[0]) && is_finite(p[1]) && is_finite(p[2])) {
        for (int a = 0; a < 3; ++a) {
          extremes[a] = fminf(extremes[a], p[a]);
          extremes[3 + a] = fminf(extremes[3 + a], -p[a]);
        }
      }
    }
    const std::uint32_t word = __ballot_sync(kWholeWarp, known);
    if (threadIdx.x % kWarpSize == 0) sums.known[i / kWarpSize] = word;
  }
  __shared__ float of_warp[kWarps][6];
  for (int a = 0; a < 6; ++a) {
    for (int offset = kWarpSize / 2; offset; offset /= 2) {
      extremes[a] = fminf(extremes[a], __shfl_xor_sync(kWholeWarp, extremes[a], offset));
    }
    if (threadIdx.x % kWarpSize == 0) of_warp[threadIdx.x / kWarpSize][a] = extremes[a];
  }
  __syncthreads();
  if (threadIdx.x < 6) {
    float least = of_warp[0][threadIdx.x];
    for (int warp = 1; warp < kWarps; ++warp) least = fminf(least, of_warp[warp][threadIdx.x]);
    counters.bounds[blockIdx.x][threadIdx.x] = least;
  }
}

// Sum over the block; every thread gets it.
__device__ std::uint32_t block_sum(std::uint32_t value, std::uint32_t* shared) {
  for (int offset = kWarpSize / 2; offset; offset /= 2) value += __shfl_xor_sync(kWholeWarp, value, offset);
  __syncthreads();
  if (threadIdx.x % kWarpSize == 0) shared[threadIdx.x / kWarpSize] = value;
  __syncthreads();
  std::uint32_t sum = 0;
  for (int warp = 0; warp < kWarps; ++warp) sum += shared[warp];
  return sum;
}

// How many of the points before this block's have a normal.
__device__ std::uint32_t known_before(const VertexSums& sums, std::uint32_t* shared) {
  std::uint32_t known = 0;
  for (unsigned word = threadIdx.x; word < blockIdx.x; word += kThreads) known += __popc(sums.known[word]);
  return block_sum(known, shared);
}

// The slot of a key, entered if it is new; -1 where the table seems to be full.
__device__ std::int32_t find_or_enter(const VertexSums& sums, std::int64_t packed, bool* entered) {
  const unsigned long long key = static_cast<unsigned long long>(packed) + 1;
  const std::int64_t mask = sums.slots - 1;
  std::int64_t slot = voxel_slot(packed, mask);
  for (int probe = 0; probe < kMaxProbes; ++probe, slot = (slot + 1) & mask) {
    unsigned long long found = __ldcg(sums.keys + slot);
    if (found == 0) {
      found = atomicCAS(sums.keys + slot, 0ull, key);
      *entered = found == 0;
      if (*entered) return static_cast<std::int32_t>(slot);
    }
    if (found == key) return static_cast<std::int32_t>(slot);
  }
  return -1;
}

// Numbers the blocks that lanes of the warp have entered, and empties their sums.
__device__ void open_blocks(const VertexSums& sums, bool entered, std::int32_t slot, std::int64_t key) {
  const std::uint32_t all = __ballot_sync(kWholeWarp, entered);
  if (all == 0) return;
  const int lane = threadIdx.x % kWarpSize;
  std::uint32_t first = 0;
  if (lane == 0) first = atomicAdd(&sums.counters->blocks, static_cast<std::uint32_t>(__popc(all)));
  first = __shfl_sync(kWholeWarp, first, 0);
  if (first + __popc(all) > sums.max_blocks) {
    sums.counters->overflow = 1;
    return;
  }
  if (entered) {
    const std::uint32_t block = first + __popc(all & ((1u << lane) - 1u));
    sums.blocks[slot] = static_cast<std::int32_t>(block);
    sums.block_keys[block] = key;
  }
  const ulonglong2 zero = make_ulonglong2(0, 0);
  ulonglong2* features =
      reinterpret_cast<ulonglong2*>(sums.features + std::int64_t{first} * kBlockVertices * kPriorFeatures);
  ulonglong2* weights = reinterpret_cast<ulonglong2*>(sums.weights + std::int64_t{first} * kBlockVertices);
  const int rows = __popc(all) * kBlockVertices / 2;
  for (int i = lane; i < rows * kPriorFeatures; i += kWarpSize) features[i] = zero;
  for (int i = lane; i < rows; i += kWarpSize) weights[i] = zero;
}

// Running sums over the block of a number below 2^16 in each half of `own`; the block's total in *total.
__device__ std::uint32_t exclusive_sum(std::uint32_t own, std::uint32_t* shared, std::uint32_t* total) {
  const int lane = threadIdx.x % kWarpSize, warp = threadIdx.x / kWarpSize;
  std::uint32_t running = own;
  for (int offset = 1; offset < kWarpSize; offset *= 2) {
    const std::uint32_t other = __shfl_up_sync(kWholeWarp, running, offset);
    if (lane >= offset) running += other;
  }
  __syncthreads();
  if (lane == kWarpSize - 1) shared[warp] = running;
  __syncthreads();
  std::uint32_t earlier = 0;
  *total = 0;
  for (int w = 0; w < kWarps; ++w) {
    if (w < warp) earlier += shared[w];
    *total += shared[w];
  }
  return earlier + running - own;
}

// Opens the blocks of vertices around 32 points and lists the pairs that count. Places in the list are reserved by
// whole blocks of threads: one counter for all pairs is a bottleneck.
__global__ void __launch_bounds__(kThreads)
    list_pairs(VertexSums sums, const float* points, const float* normals, std::int64_t max_points, bool limited,
               EncoderSettings settings) {
  __shared__ std::uint32_t shared[kWarps], first_pair;
  const Neighborhood neighborhood = neighborhood_of(settings.neighborhood);
  const int bits = side_bits(neighborhood), side_mask = neighborhood.side - 1;
  const int lane = threadIdx.x % kWarpSize, warp = threadIdx.x / kWarpSize;
  const std::uint32_t word = sums.known[blockIdx.x];
  const std::int64_t before = limited ? known_before(sums, shared) : 0;
  const float inverse_voxel_size = 1.0f / settings.voxel_size;
  // Eight lanes for each of the warp's four points: a lane looks up one block of vertices.
  const int own_bit = warp * kPointsPerWarp + lane / kBlocksPerPoint;
  const std::int64_t own_point = static_cast<std::int64_t>(blockIdx.x) * kPointsPerBlock + own_bit;
  const bool taken =
      (word >> own_bit & 1u) && !(limited && before + __popc(word & ((1u << own_bit) - 1u)) >= max_points);
  EncodedPoint point{{0, 0, 0}, {0.0f, 0.0f, 0.0f}, false};
  if (taken) point = locate_point(points + 3 * own_point, normals + 3 * own_point, inverse_voxel_size);
  const VoxelCoord first{point.cell.x + neighborhood.first, point.cell.y + neighborhood.first,
                         point.cell.z + neighborhood.first};
  const VoxelCoord last{first.x + side_mask, first.y + side_mask, first.z + side_mask};
  const int upper = lane % kBlocksPerPoint;
  const VoxelCoord block{(upper & 1 ? last.x : first.x) >> kBlockSideBits,
                         (upper & 2 ? last.y : first.y) >> kBlockSideBits,
                         (upper & 4 ? last.z : first.z) >> kBlockSideBits};
  // Where both ends of the neighborhood lie in one block, the lane of the lower end looks it up.
  const bool repeated = (upper & 1 && block.x == first.x >> kBlockSideBits) ||
                        (upper & 2 && block.y == first.y >> kBlockSideBits) ||
                        (upper & 4 && block.z == first.z >> kBlockSideBits);
  bool entered = false;
  std::int32_t slot = -1;
  if (point.valid && !repeated) {
    slot = find_or_enter(sums, pack_voxel(block), &entered);
    if (slot < 0) sums.counters->overflow = 1;
  }
  __syncwarp();
  open_blocks(sums, entered, slot, pack_voxel(block));
  std::uint32_t vertices[kPairsPerThread], counted = 0;
#pragma unroll
  for (int k = 0; k < kPairsPerThread; ++k) {
    const int pair = k * kWarpSize + lane, owner = min(pair >> (3 * bits), kPointsPerWarp - 1);
    EncodedPoint of_pair;
    of_pair.valid = __shfl_sync(kWholeWarp, point.valid, owner * kBlocksPerPoint);
    of_pair.local.x = __shfl_sync(kWholeWarp, point.local.x, owner * kBlocksPerPoint);
    of_pair.local.y = __shfl_sync(kWholeWarp, point.local.y, owner * kBlocksPerPoint);
    of_pair.local.z = __shfl_sync(kWholeWarp, point.local.z, owner * kBlocksPerPoint);
    const int x = pair >> (2 * bits) & side_mask, y = pair >> bits & side_mask, z = pair & side_mask;
    const int at_x = (__shfl_sync(kWholeWarp, first.x, owner * kBlocksPerPoint) & (kBlockSide - 1)) + x;
    const int at_y = (__shfl_sync(kWholeWarp, first.y, owner * kBlocksPerPoint) & (kBlockSide - 1)) + y;
    const int at_z = (__shfl_sync(kWholeWarp, first.z, owner * kBlocksPerPoint) & (kBlockSide - 1)) + z;
    const int holder = at_x / kBlockSide | at_y / kBlockSide << 1 | at_z / kBlockSide << 2;
    const std::int32_t slot_of_pair = __shfl_sync(kWholeWarp, slot, owner * kBlocksPerPoint + holder);
    const bool counts = pair >> (3 * bits) < kPointsPerWarp && of_pair.valid && slot_of_pair >= 0 &&
                        pair_counts(encoder_input(neighborhood, of_pair, x, y, z).weight, settings.min_pair_weight);
    const int place = (at_x % kBlockSide * kBlockSide + at_y % kBlockSide) * kBlockSide + at_z % kBlockSide;
    vertices[k] = static_cast<std::uint32_t>(slot_of_pair) * kBlockVertices + place;
    counted |= static_cast<std::uint32_t>(counts) << k;
  }
  std::uint32_t total = 0;
  const std::uint32_t start = exclusive_sum(__popc(counted), shared, &total);
  if (threadIdx.x == 0) first_pair = atomicAdd(&sums.counters->pairs, total);
  __syncthreads();
  PointPair* out = sums.pairs + first_pair + start;
  const std::uint32_t first_of_warp = (blockIdx.x * kPointsPerBlock + warp * kPointsPerWarp) << (3 * bits);
#pragma unroll
  for (int k = 0; k < kPairsPerThread; ++k) {
    if (counted >> k & 1u) *out++ = {vertices[k], first_of_warp + k * kWarpSize + lane};
  }
}

}  // namespace

VertexSums lay_out_sums(void* workspace, std::int64_t n, std::int64_t max_points, std::int32_t neighborhood,
                        int attempt, std::size_t* bytes) {
  const std::int64_t points = std::max<std::int64_t>(std::min(n, max_points), 64);
  VertexSums sums{};
  const std::int64_t expected = 3072 + points / 8;  // a room seen by a camera takes less
  sums.max_blocks = std::min(kBlocksPerPoint * points, expected << std::min(4 * attempt, 32));
  for (sums.slots = 1; sums.slots < 2 * sums.max_blocks;) sums.slots *= 2;
  sums.weight_scale = weight_scale(n);
  sums.feature_scale = sum_scale(n, kLargestFeatureBits);
  Workspace memory(workspace);
  const auto take = [&](auto*& array, std::int64_t count) {
    array = memory.take<std::remove_pointer_t<std::decay_t<decltype(array)>>>(count);
  };
  const std::int64_t vertices = sums.max_blocks * kBlockVertices;
  take(sums.counters, 1);
  take(sums.keys, sums.slots);
  take(sums.blocks, sums.slots);
  take(sums.block_keys, sums.max_blocks);
  take(sums.features, kPriorFeatures * vertices);
  take(sums.weights, vertices);
  take(sums.listed_keys, vertices);
  take(sums.listed, vertices);
  take(sums.found, vertices);
  take(sums.found_ids, vertices);
  take(sums.pairs, std::min(n, max_points) * neighborhood);
  take(sums.known, (n + kWarpSize - 1) / kWarpSize);
  *bytes = static_cast<std::size_t>(memory.used());
  return sums;
}

void sum_over_vertices(Cuda device, const VertexSums& sums, const float* points, const float* normals, std::int64_t n,
                       std::int64_t max_points, const float* params, const EncoderSettings& settings) {
  if (n > INT32_MAX / settings.neighborhood || sums.slots > INT32_MAX / kBlockVertices) {
    throw std::length_error("encode_points: too many points for one call");
  }
  const cudaStream_t stream = static_cast<cudaStream_t>(device.stream);
  const std::int64_t blocks = std::clamp<std::int64_t>((n + kThreads - 1) / kThreads, 1, kBoundsRows);
  prepare_points<<<static_cast<int>(blocks), kThreads, 0, stream>>>(sums, points, normals, n);
  if (n > 0 && max_points > 0) {
    const int words = static_cast<int>((n + kPointsPerBlock - 1) / kPointsPerBlock);
    list_pairs<<<words, kThreads, 0, stream>>>(sums, points, normals, max_points, max_points < n, settings);
    encode_listed_pairs(device, sums, points, normals, params, settings);
  }
  SPS_CUDA_CHECK(cudaGetLastError());
}

SumCounters read_counters(Cuda device, const VertexSums& sums) {
  const cudaStream_t stream = static_cast<cudaStream_t>(device.stream);
  SumCounters counters;
  SPS_CUDA_CHECK(cudaMemcpyAsync(&counters, sums.counters, sizeof(counters), cudaMemcpyDeviceToHost, stream));
  SPS_CUDA_CHECK(cudaStreamSynchronize(stream));
  return counters;
}

}  // namespace spslam
