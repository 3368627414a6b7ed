#include "core/cuda_check.cuh"
#include "cuda/point_encoder.cuh"
#include "cuda/vertex_sums.cuh"

namespace spslam {
namespace {

__device__ void add_feature(const VertexSums& sums, std::int64_t vertex, int channel, float term) {
  if (!(fabsf(term) < kLargestFeature)) {
    sums.counters->poisoned = 1;
    return;
  }
  atomicAdd(sums.features + kPriorFeatures * vertex + channel,
            static_cast<unsigned long long>(__float2ll_rn(term * sums.feature_scale)));
}

constexpr int kStagedStride = 12;  // floats: reads of one column by all lanes then hit different banks

template <MlpPrecision kPrecision>
constexpr int encoder_warps() {
  return kPrecision == MlpPrecision::kTf32 ? 16 : 4;
}

// A lane's part of the next 32 pairs of its warp.
struct LoadedPair {
  std::int32_t block = -1;  // of the vertex; -1 past the end of the list
  std::uint32_t place = 0;
  std::uint32_t corner = 0;
  float point[3] = {}, normal[3] = {};
};

__device__ __forceinline__ LoadedPair load_pair(const VertexSums& sums, std::int64_t index, std::int64_t count,
                                                const float* points, const float* normals, int corner_bits) {
  LoadedPair loaded;
  if (index >= count) return loaded;
  const PointPair pair = sums.pairs[index];
  const std::int64_t i = pair.pair >> corner_bits;
  loaded.corner = pair.pair & ((1u << corner_bits) - 1u);
  loaded.place = pair.vertex % kBlockVertices;
  loaded.block = sums.blocks[pair.vertex / kBlockVertices];
  for (int a = 0; a < 3; ++a) {
    loaded.point[a] = points[3 * i + a];
    loaded.normal[a] = normals[3 * i + a];
  }
  return loaded;
}

// Encodes the listed pairs, 32 per warp at a time, and adds them to the sums of their vertices.
template <MlpPrecision kPrecision>
__global__ void __launch_bounds__(encoder_warps<kPrecision>() * kWarpSize)
    encode_listed(VertexSums sums, const float* points, const float* normals, const float* params,
                  EncoderSettings settings) {
  constexpr int kWarps = encoder_warps<kPrecision>();
  __shared__ EncoderWeights<kPrecision> weights;
  __shared__ alignas(16) float staged[kWarps][kPairsPerWarp][kStagedStride];
  if (sums.counters->overflow) return;
  const Neighborhood neighborhood = neighborhood_of(settings.neighborhood);
  const int bits = side_bits(neighborhood), side_mask = neighborhood.side - 1;
  const int lane = threadIdx.x % kWarpSize, warp = threadIdx.x / kWarpSize, row = lane / 4, column = lane % 4;
  const float inverse_voxel_size = 1.0f / settings.voxel_size;
  const std::int64_t count = sums.counters->pairs;
  const std::int64_t stride = static_cast<std::int64_t>(gridDim.x) * kWarps * kPairsPerWarp;
  std::int64_t index = (static_cast<std::int64_t>(blockIdx.x) * kWarps + warp) * kPairsPerWarp + lane;
  LoadedPair next = load_pair(sums, index, count, points, normals, 3 * bits);
  weights.load(params);
  __syncthreads();
  float (&inputs)[kPairsPerWarp][kStagedStride] = staged[warp];
  for (; index - lane < count; index += stride) {
    const LoadedPair pair = next;
    const EncodedPoint point = locate_point(pair.point, pair.normal, inverse_voxel_size);
    const EncoderInput input = encoder_input(neighborhood, point, pair.corner >> (2 * bits),
                                             pair.corner >> bits & side_mask, pair.corner & side_mask);
    const std::int64_t vertex = static_cast<std::int64_t>(pair.block) * kBlockVertices + pair.place;
    *reinterpret_cast<float4*>(inputs[lane]) =
        make_float4(input.position[0], input.position[1], input.position[2], pair.normal[0]);
    *reinterpret_cast<float4*>(inputs[lane] + 4) = make_float4(pair.normal[1], pair.normal[2], 0.0f, 0.0f);
    // Loaded before the products, which hide the latency.
    next = load_pair(sums, index + stride, count, points, normals, 3 * bits);
    if (pair.block >= 0) {
      atomicAdd(sums.weights + vertex, static_cast<unsigned long long>(weight_units(input.weight, sums.weight_scale)));
    }
    __syncwarp();
    FactorTile<kPrecision> tiles[kPairTiles];
#pragma unroll
    for (int m = 0; m < kPairTiles; ++m) {
      const float *upper = inputs[kTileSamples * m + row], *lower = inputs[kTileSamples * m + 8 + row];
      tiles[m] = factors<kPrecision>(upper[column], lower[column], upper[column + 4], lower[column + 4]);
    }
    __syncwarp();
    float features[kPairTiles][4];
    encode_pairs(weights, tiles, lane, features);
#pragma unroll
    for (int i = 0; i < 2 * kPairTiles; ++i) {
      const float weight = __shfl_sync(kWholeWarp, input.weight, 8 * i + row);
      const std::int32_t vertex_of_row =
          __shfl_sync(kWholeWarp, pair.block < 0 ? -1 : static_cast<std::int32_t>(vertex), 8 * i + row);
      if (vertex_of_row < 0) continue;
      add_feature(sums, vertex_of_row, column, weight * features[i / 2][i % 2 * 2]);
      add_feature(sums, vertex_of_row, 4 + column, weight * features[i / 2][i % 2 * 2 + 1]);
    }
  }
}

template <MlpPrecision kPrecision>
void launch_encoder(Cuda device, const VertexSums& sums, const float* points, const float* normals, const float* params,
                    const EncoderSettings& settings) {
  constexpr int kBlocksPerProcessor = kPrecision == MlpPrecision::kTf32 ? 1 : 2;
  int gpu = 0, processors = 0;
  SPS_CUDA_CHECK(cudaGetDevice(&gpu));
  SPS_CUDA_CHECK(cudaDeviceGetAttribute(&processors, cudaDevAttrMultiProcessorCount, gpu));
  encode_listed<kPrecision><<<kBlocksPerProcessor * processors, encoder_warps<kPrecision>() * kWarpSize, 0,
                              static_cast<cudaStream_t>(device.stream)>>>(sums, points, normals, params, settings);
  SPS_CUDA_CHECK(cudaGetLastError());
}

}  // namespace

void encode_listed_pairs(Cuda device, const VertexSums& sums, const float* points, const float* normals,
                         const float* params, const EncoderSettings& settings) {
  if (settings.tf32) {
    launch_encoder<MlpPrecision::kTf32>(device, sums, points, normals, params, settings);
  } else {
    launch_encoder<MlpPrecision::kFloat32>(device, sums, points, normals, params, settings);
  }
}

}  // namespace spslam
