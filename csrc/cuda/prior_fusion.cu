#include <cub/device/device_radix_sort.cuh>

#include "core/cuda_check.cuh"
#include "cuda/vertex_sums.cuh"
#include "kernels/depth_normal.h"
#include "kernels/voxel_hash.h"
#include "launch/prior_fusion.h"

namespace spslam {
namespace {

// Lists all vertices that a pair reaches.
void list_vertices(Cuda device, const VertexSums& sums) {
  const std::int64_t most = sums.max_blocks * kBlockVertices;
  for_each(device, most, [=] __device__(std::int64_t i) {
    if (i >= num_vertices(sums)) return;  // a multiple of 64, so warps stay whole
    const bool reached = sums.weights[i] != 0;
    list_vertex(sums, reached, reached ? vertex_key(sums, i) : 0, i);
  });
}

// Writes the vertices listed in the order of their coordinates.
void write_sorted(Cuda device, const VertexSums& sums, std::int64_t vertices, const AllocateScratch& scratch,
                  const EncodedVoxels& out) {
  const cudaStream_t stream = static_cast<cudaStream_t>(device.stream);
  const int count = static_cast<int>(vertices);
  unsigned long long* keys = static_cast<unsigned long long*>(scratch(vertices * sizeof(*keys)));
  const auto sort = [&](void* workspace, std::size_t* bytes) {
    SPS_CUDA_CHECK(cub::DeviceRadixSort::SortPairs(workspace, *bytes, sums.listed_keys, keys, sums.listed, sums.found,
                                                   count, 0, 64, stream));
  };
  std::size_t bytes = 0;
  sort(nullptr, &bytes);
  sort(scratch(static_cast<std::int64_t>(bytes)), &bytes);
  for_each(device, vertices, [=] __device__(std::int64_t i) {
    const VoxelCoord coord = unpack_voxel(static_cast<std::int64_t>(keys[i]));
    out.voxel_coords[3 * i] = coord.x;
    out.voxel_coords[3 * i + 1] = coord.y;
    out.voxel_coords[3 * i + 2] = coord.z;
    const float weight = vertex_weight(sums, sums.found[i]);
    out.weights[i] = weight;
    for (int c = 0; c < kPriorFeatures; ++c) {
      out.features[kPriorFeatures * i + c] = vertex_feature(sums, sums.found[i], c, weight);
    }
  });
}

}  // namespace

template <>
void encode_points<Cuda>(Cuda device, const float* points, const float* normals, std::int64_t n, const float* params,
                         const EncoderSettings& settings, const AllocateScratch& scratch,
                         const AllocateEncodedVoxels& allocate) {
  for (int attempt = 0;; ++attempt) {
    std::size_t bytes = 0;
    lay_out_sums(nullptr, n, n, settings.neighborhood, attempt, &bytes);
    void* workspace = scratch(static_cast<std::int64_t>(bytes));
    const VertexSums sums = lay_out_sums(workspace, n, n, settings.neighborhood, attempt, &bytes);
    sum_over_vertices(device, sums, points, normals, n, n, params, settings);
    list_vertices(device, sums);
    const SumCounters counters = read_counters(device, sums);
    if (counters.overflow) continue;
    const EncodedVoxels out = allocate(counters.listed);
    if (counters.listed > 0) write_sorted(device, sums, counters.listed, scratch, out);
    return;
  }
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
