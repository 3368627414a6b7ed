#include <algorithm>

#include "core/cuda_check.cuh"
#include "cuda/mlp_fragments.cuh"
#include "cuda/vertex_sums.cuh"
#include "kernels/prior_fusion.h"
#include "launch/voxel_hash.h"

namespace spslam {
namespace {

constexpr int kThreads = 256;
constexpr std::int32_t kLeftOut = -2;

struct FuseFrame {
  VertexSums sums;
  FeatureVolume volume;
  float min_weight, kappa, max_weight;
  bool fuse_known;

  __device__ VoxelTable table() const { return {volume.hash_keys, volume.hash_values, volume.hash_capacity - 1}; }
  // Whether there is room for the vertices that the volume lacks.
  __device__ bool fits() const { return volume.num_voxels + sums.counters->listed <= volume.max_voxels; }
};

// Finds the vertices that weigh enough in the volume and lists those it lacks. Changes nothing in it.
__global__ void __launch_bounds__(kThreads) resolve_vertices(FuseFrame frame) {
  const VertexSums& sums = frame.sums;
  const std::int64_t vertices = num_vertices(sums), stride = static_cast<std::int64_t>(gridDim.x) * kThreads;
  // Blocks hold 64 vertices, so warps stay whole.
  for (std::int64_t i = blockIdx.x * static_cast<std::int64_t>(kThreads) + threadIdx.x; i < vertices; i += stride) {
    std::int32_t id = kLeftOut;
    std::int64_t key = 0;
    if (sums.weights[i] != 0 && vertex_weight(sums, i) > frame.min_weight) {
      key = vertex_key(sums, i);
      id = find_voxel_key(frame.table(), key);
    }
    list_vertex(sums, id == kNoVoxel, key, i);
    const std::uint32_t place = list_place(id >= 0, &sums.counters->found);
    if (id < 0) continue;
    sums.found[place] = static_cast<std::int32_t>(i);
    sums.found_ids[place] = id;
  }
}

// Equation (1) for a vertex, by the eight lanes of its features.
__device__ void fuse_vertex(const FuseFrame& frame, std::int64_t vertex, std::int64_t id, int channel) {
  const float weight = vertex_weight(frame.sums, vertex), share = fusion_share(weight, frame.kappa);
  const float feature = vertex_feature(frame.sums, vertex, channel, weight);
  float* embedding = frame.volume.embeddings + kPriorFeatures * id + channel;
  const float before = frame.volume.weights[id];
  *embedding = fused_feature(*embedding, before, feature, share);
  __syncwarp(0xffu << (threadIdx.x % kWarpSize - channel));  // all eight have read the weight
  if (channel == 0) frame.volume.weights[id] = fused_weight(before, share, frame.max_weight);
}

__device__ void enter_voxel(const FeatureVolume& volume, std::int64_t key, std::int32_t id) {
  const std::int64_t mask = volume.hash_capacity - 1;
  unsigned long long* keys = reinterpret_cast<unsigned long long*>(volume.hash_keys);
  constexpr unsigned long long kEmpty = static_cast<unsigned long long>(kEmptyVoxelKey);
  std::int64_t slot = voxel_slot(key, mask);
  for (std::int64_t probes = 0; probes < volume.hash_capacity; ++probes, slot = (slot + 1) & mask) {
    if (atomicCAS(keys + slot, kEmpty, static_cast<unsigned long long>(key)) != kEmpty) continue;
    volume.hash_values[slot] = id;
    break;
  }
  const VoxelCoord coord = unpack_voxel(key);
  std::int32_t* row = volume.voxel_coords + 3 * static_cast<std::int64_t>(id);
  row[0] = coord.x;
  row[1] = coord.y;
  row[2] = coord.z;
}

// How many of the keys listed are smaller than this one; by a warp.
__device__ int count_smaller(const VertexSums& sums, std::uint32_t count, unsigned long long key) {
  int smaller = 0;
#pragma unroll 8
  for (std::uint32_t other = threadIdx.x % kWarpSize; other < count; other += kWarpSize) {
    smaller += sums.listed_keys[other] < key;
  }
  for (int offset = kWarpSize / 2; offset; offset /= 2) smaller += __shfl_xor_sync(kWholeWarp, smaller, offset);
  return smaller;
}

// Fuses known vertices and inserts new ones, one warp each. The number of a new vertex is that of smaller keys among
// the new: counting them is faster than a sort, as a frame adds some hundreds.
__global__ void __launch_bounds__(kThreads) fuse_vertices(FuseFrame frame) {
  if (!frame.fits()) return;
  const VertexSums& sums = frame.sums;
  const std::int64_t stride = static_cast<std::int64_t>(gridDim.x) * kThreads;
  const std::int64_t thread = blockIdx.x * static_cast<std::int64_t>(kThreads) + threadIdx.x;
  const int lane = threadIdx.x % kWarpSize, channel = threadIdx.x % kPriorFeatures;
  const std::uint32_t fresh = sums.counters->listed;
  for (std::int64_t i = thread / kWarpSize; i < fresh; i += stride / kWarpSize) {
    const unsigned long long key = sums.listed_keys[i];
    const std::int32_t id = static_cast<std::int32_t>(frame.volume.num_voxels) + count_smaller(sums, fresh, key);
    if (lane == kWarpSize - 1) enter_voxel(frame.volume, static_cast<std::int64_t>(key), id);
    if (lane < kPriorFeatures) fuse_vertex(frame, sums.listed[i], id, channel);
  }
  if (!frame.fuse_known) return;
  const std::int64_t known = static_cast<std::int64_t>(sums.counters->found) * kPriorFeatures;
  for (std::int64_t i = thread; i < known; i += stride) {
    fuse_vertex(frame, sums.found[i / kPriorFeatures], sums.found_ids[i / kPriorFeatures], channel);
  }
}

// update_corner_row by eight lanes, one per corner: in sequence the searches would take most of the time.
__device__ void update_corner_row_together(const FuseFrame& frame, std::int32_t id, int k) {
  const int corner = threadIdx.x % kCellCorners, first_lane = threadIdx.x % kWarpSize - corner;
  const std::uint32_t together = 0xffu << first_lane;
  const std::int64_t first_new = frame.volume.num_voxels;
  const VoxelCoord vertex = load_voxel(frame.volume.voxel_coords, id);
  const VoxelCoord lowest{vertex.x - (k & 1), vertex.y - ((k >> 1) & 1), vertex.z - ((k >> 2) & 1)};
  const std::int32_t own = find_voxel(frame.table(), cell_corner(lowest, corner));
  const bool complete = __ballot_sync(together, own != kNoVoxel) == together;
  const bool new_before = __ballot_sync(together, corner < k && own >= first_new) != 0;
  const std::int32_t row = __shfl_sync(together, own, first_lane);
  // A new vertex writes its own row, and older ones that it completes and of which it is the first new corner.
  if (row == kNoVoxel || (k != 0 && (!complete || new_before))) return;
  frame.volume.corner_ids[static_cast<std::int64_t>(kCellCorners) * row + corner] = complete ? own : kNoVoxel;
}

__global__ void __launch_bounds__(kThreads) complete_corner_rows(FuseFrame frame) {
  if (!frame.fits()) return;
  const std::int64_t work = static_cast<std::int64_t>(frame.sums.counters->listed) * kCellCorners * kCellCorners;
  const std::int64_t stride = static_cast<std::int64_t>(gridDim.x) * kThreads;
  for (std::int64_t i = blockIdx.x * static_cast<std::int64_t>(kThreads) + threadIdx.x; i < work; i += stride) {
    const std::int64_t fresh = i / (kCellCorners * kCellCorners);
    update_corner_row_together(frame, static_cast<std::int32_t>(frame.volume.num_voxels + fresh),
                               static_cast<int>(i / kCellCorners % kCellCorners));
  }
}

EncodedFrame summary(const SumCounters& counters, const FeatureVolume& volume) {
  EncodedFrame result{};
  result.new_voxels = counters.listed;
  result.fits = volume.num_voxels + result.new_voxels <= volume.max_voxels;
  for (int a = 0; a < 3; ++a) {
    result.low[a] = result.high[a] = 0.0f;
    float low = counters.bounds[0][a], high = counters.bounds[0][3 + a];
    for (const float (&bounds)[6] : counters.bounds) {
      low = std::min(low, bounds[a]);
      high = std::min(high, bounds[3 + a]);
    }
    result.low[a] = low;
    result.high[a] = -high;
  }
  return result;
}

}  // namespace

template <>
EncodedFrame encode_frame<Cuda>(Cuda device, const FeatureVolume& volume, const float* points, const float* normals,
                                std::int64_t n, const float* params, const FusionSettings& settings,
                                const AllocateScratch& scratch) {
  constexpr int kBlocks = 1056;  // as many as an H100 holds at once: these kernels wait for memory
  const cudaStream_t stream = static_cast<cudaStream_t>(device.stream);
  for (int attempt = 0;; ++attempt) {
    const std::int32_t neighborhood = settings.encoder.neighborhood;
    std::size_t bytes = 0;
    lay_out_sums(nullptr, n, settings.max_points, neighborhood, attempt, &bytes);
    void* workspace = scratch(static_cast<std::int64_t>(bytes));
    const FuseFrame frame{lay_out_sums(workspace, n, settings.max_points, neighborhood, attempt, &bytes),
                          volume,
                          settings.min_weight,
                          settings.kappa,
                          settings.max_weight,
                          settings.fuse_known};
    sum_over_vertices(device, frame.sums, points, normals, n, settings.max_points, params, settings.encoder);
    resolve_vertices<<<kBlocks, kThreads, 0, stream>>>(frame);
    fuse_vertices<<<kBlocks, kThreads, 0, stream>>>(frame);
    complete_corner_rows<<<kBlocks, kThreads, 0, stream>>>(frame);
    SPS_CUDA_CHECK(cudaGetLastError());
    const SumCounters counters = read_counters(device, frame.sums);
    if (!counters.overflow) return summary(counters, volume);
  }
}

}  // namespace spslam
