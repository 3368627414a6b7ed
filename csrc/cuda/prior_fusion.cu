#include <cub/device/device_radix_sort.cuh>
#include <cub/device/device_run_length_encode.cuh>
#include <cub/device/device_scan.cuh>
#include <stdexcept>

#include "core/cuda_check.cuh"
#include "kernels/depth_normal.h"
#include "kernels/prior_fusion_launch.h"

namespace spslam {
namespace {

// Sorted last, as an unsigned number; no packed coordinate reaches it.
constexpr std::uint64_t kNoVertex = ~std::uint64_t{0};

std::size_t aligned(std::size_t bytes) {
  return (bytes + 255) & ~std::size_t{255};
}

// What a call keeps on the device, for pairs of a point and a vertex: point * neighbourhood + corner.
struct Workspace {
  Workspace(void* base, std::int64_t pairs) : cursor_(static_cast<char*>(base)), start_(cursor_) {
    keys = take<std::uint64_t>(pairs);
    sorted_keys = take<std::uint64_t>(pairs);
    vertex_keys = take<std::uint64_t>(pairs);
    ids = take<std::int32_t>(pairs);
    sorted_ids = take<std::int32_t>(pairs);
    counts = take<std::int32_t>(pairs);
    ends = take<std::int32_t>(pairs);
    features = take<float>(pairs * kPriorFeatures);
    weights = take<float>(pairs);
    summary = take<std::uint64_t>(2);
    std::size_t sort = 0, encode = 0, scan = 0;
    const int n = static_cast<int>(pairs);
    SPS_CUDA_CHECK(cub::DeviceRadixSort::SortPairs(nullptr, sort, keys, sorted_keys, ids, sorted_ids, n));
    SPS_CUDA_CHECK(cub::DeviceRunLengthEncode::Encode(nullptr, encode, sorted_keys, vertex_keys, counts, summary, n));
    SPS_CUDA_CHECK(cub::DeviceScan::InclusiveSum(nullptr, scan, counts, ends, n));
    scratch_bytes = sort > encode ? sort : encode;
    scratch_bytes = scratch_bytes > scan ? scratch_bytes : scan;
    scratch = take<char>(scratch_bytes);
  }

  std::size_t bytes() const { return static_cast<std::size_t>(cursor_ - start_); }

  std::uint64_t *keys, *sorted_keys, *vertex_keys;
  std::int32_t *ids, *sorted_ids, *counts, *ends;
  float *features, *weights;
  std::uint64_t* summary;  // number of distinct keys, the last of them
  char* scratch;
  std::size_t scratch_bytes;

 private:
  template <class T>
  T* take(std::size_t count) {
    T* region = reinterpret_cast<T*>(cursor_);
    cursor_ += aligned(count * sizeof(T));
    return region;
  }
  char *cursor_, *start_;
};

// Key, weight and features of every pair.
void encode_pairs(Cuda device, const float* points, const float* normals, std::int64_t pairs, const float* params,
                  const EncoderSettings& settings, const Workspace& space) {
  const Neighborhood neighborhood = neighborhood_of(settings.neighborhood);
  const float inverse_voxel_size = 1.0f / settings.voxel_size, min_pair_weight = settings.min_pair_weight;
  for_each(device, pairs, [=] __device__(std::int64_t pair) {
    const std::int64_t i = pair / neighborhood.corners();
    const int corner = static_cast<int>(pair % neighborhood.corners()), side = neighborhood.side;
    const int x = corner / (side * side), y = corner / side % side, z = corner % side;
    const float* normal = normals + 3 * i;
    const EncodedPoint point = locate_point(points + 3 * i, normal, inverse_voxel_size);
    const float input[kEncoderInputs] = {relative_position(neighborhood, point.local.x, x),
                                         relative_position(neighborhood, point.local.y, y),
                                         relative_position(neighborhood, point.local.z, z),
                                         normal[0],
                                         normal[1],
                                         normal[2]};
    const float weight = pair_weight(input[0], input[1], input[2]);
    const bool counts = point.valid && pair_counts(weight, min_pair_weight);
    space.ids[pair] = static_cast<std::int32_t>(pair);
    space.keys[pair] = kNoVertex;
    if (!counts) return;
    const VoxelCoord vertex{point.cell.x + neighborhood.first + x, point.cell.y + neighborhood.first + y,
                            point.cell.z + neighborhood.first + z};
    space.keys[pair] = static_cast<std::uint64_t>(pack_voxel(vertex));
    space.weights[pair] = weight;
    float features[kPriorFeatures];
    encode_pair(params, input, features);
    for (int c = 0; c < kPriorFeatures; ++c) space.features[kPriorFeatures * pair + c] = features[c];
  });
}

// Sorts pairs by vertex, those of a vertex in their own order; returns how many vertices there are.
std::int64_t group_pairs(Cuda device, int pairs, const Workspace& space) {
  const cudaStream_t stream = static_cast<cudaStream_t>(device.stream);
  std::size_t bytes = space.scratch_bytes;
  SPS_CUDA_CHECK(cub::DeviceRadixSort::SortPairs(space.scratch, bytes, space.keys, space.sorted_keys, space.ids,
                                                 space.sorted_ids, pairs, 0, 64, stream));
  bytes = space.scratch_bytes;
  SPS_CUDA_CHECK(cub::DeviceRunLengthEncode::Encode(space.scratch, bytes, space.sorted_keys, space.vertex_keys,
                                                    space.counts, space.summary, pairs, stream));
  for_each(device, 1, [=] __device__(std::int64_t) { space.summary[1] = space.sorted_keys[pairs - 1]; });
  std::uint64_t summary[2];
  SPS_CUDA_CHECK(cudaMemcpyAsync(summary, space.summary, sizeof(summary), cudaMemcpyDeviceToHost, stream));
  SPS_CUDA_CHECK(cudaStreamSynchronize(stream));
  const std::int64_t vertices = static_cast<std::int64_t>(summary[0]) - (summary[1] == kNoVertex);
  bytes = space.scratch_bytes;
  SPS_CUDA_CHECK(cub::DeviceScan::InclusiveSum(space.scratch, bytes, space.counts, space.ends,
                                               static_cast<int>(vertices), stream));
  return vertices;
}

// One thread a vertex, its pairs in order: the same sum on every run.
void average_pairs(Cuda device, std::int64_t vertices, const Workspace& space, const EncodedVoxels& out) {
  for_each(device, vertices, [=] __device__(std::int64_t row) {
    float sums[kPriorFeatures] = {}, total = 0.0f;
    for (std::int32_t i = space.ends[row] - space.counts[row]; i < space.ends[row]; ++i) {
      const std::int64_t pair = space.sorted_ids[i];
      const float weight = space.weights[pair];
      for (int c = 0; c < kPriorFeatures; ++c) sums[c] += weight * space.features[kPriorFeatures * pair + c];
      total += weight;
    }
    const VoxelCoord coord = unpack_voxel(static_cast<std::int64_t>(space.vertex_keys[row]));
    out.voxel_coords[3 * row] = coord.x;
    out.voxel_coords[3 * row + 1] = coord.y;
    out.voxel_coords[3 * row + 2] = coord.z;
    out.weights[row] = total;
    for (int c = 0; c < kPriorFeatures; ++c) out.features[kPriorFeatures * row + c] = sums[c] / total;
  });
}

}  // namespace

template <>
std::int64_t encode_points_workspace_bytes<Cuda>(Cuda, std::int64_t n, std::int32_t neighborhood) {
  return static_cast<std::int64_t>(Workspace(nullptr, n * neighborhood).bytes());
}

template <>
void encode_points<Cuda>(Cuda device, const float* points, const float* normals, std::int64_t n, const float* params,
                         const EncoderSettings& settings, void* workspace, const AllocateEncodedVoxels& allocate) {
  const std::int64_t pairs = n * settings.neighborhood;
  if (pairs == 0) {
    allocate(0);
    return;
  }
  if (pairs > INT32_MAX) throw std::length_error("encode_points: too many points for one call");
  const Workspace space(workspace, pairs);
  encode_pairs(device, points, normals, pairs, params, settings, space);
  const std::int64_t vertices = group_pairs(device, static_cast<int>(pairs), space);
  average_pairs(device, vertices, space, allocate(vertices));
}

template <>
void depth_normals<Cuda>(Cuda device, const DepthImage& image, const std::int32_t* pixels, std::int64_t n,
                         std::int32_t step_px, float max_jump, float* normals) {
  for_each(device, n, [=] __device__(std::int64_t i) {
    const Vec3<float> normal = depth_normal(image, pixels[2 * i], pixels[2 * i + 1], step_px, max_jump);
    normals[3 * i] = normal.x;
    normals[3 * i + 1] = normal.y;
    normals[3 * i + 2] = normal.z;
  });
}

SPS_INSTANTIATE_PRIOR_FUSION(Cuda)

}  // namespace spslam
