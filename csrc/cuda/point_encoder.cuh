// The depth encoder by one warp, in registers: 32 pairs of a point and a vertex at a time, on tensor cores.
//
// The pairs are two tiles of 16, so that every weight read from shared memory serves two products. A tile's hidden
// units have the layout of mma.sync's accumulators; the order of a layer's inputs is free as long as the weights follow
// it, so weights are stored such that one layer's result is the next one's input without shuffles.
#pragma once

#include "cuda/mlp_fragments.cuh"
#include "spslam/prior_fusion.h"

namespace spslam {

constexpr int kPairTiles = 2;
constexpr int kPairsPerWarp = kPairTiles * kTileSamples;

// One lane's part of a 16 x 8 matrix of factors. kTf32 keeps the ten leading bits of each mantissa; kFloat32 keeps the
// next ten in `low` too, so that three products give what float32 would, but for rounding.
template <MlpPrecision kPrecision>
struct FactorTile {
  std::uint32_t high[4];
  std::uint32_t low[kPrecision == MlpPrecision::kFloat32 ? 4 : 1];
};

// sum + a b on a 16 x 8 x 8 product where there are no tensor cores. Not inlined: a hundred copies would keep the
// compiler busy for many minutes.
__device__ __noinline__ inline float4 multiply_tile_plainly(float4 sum, uint4 a, float2 b) {
  const int lane = threadIdx.x % kWarpSize, row = lane / 4, column = 2 * (lane % 4);
#pragma unroll 1
  for (int k = 0; k < 8; ++k) {
    const int source = k % 4;
    const float upper = __shfl_sync(kWholeWarp, __uint_as_float(k < 4 ? a.x : a.z), 4 * row + source);
    const float lower = __shfl_sync(kWholeWarp, __uint_as_float(k < 4 ? a.y : a.w), 4 * row + source);
    const float left = __shfl_sync(kWholeWarp, k < 4 ? b.x : b.y, 4 * column + source);
    const float right = __shfl_sync(kWholeWarp, k < 4 ? b.x : b.y, 4 * (column + 1) + source);
    sum.x += upper * left;
    sum.y += upper * right;
    sum.z += lower * left;
    sum.w += lower * right;
  }
  return sum;
}

// sum += a b on a 16 x 8 x 8 product.
__device__ __forceinline__ void multiply_tile(float (&sum)[4], const std::uint32_t (&a)[4], float b0, float b1) {
#if defined(__CUDA_ARCH__) && __CUDA_ARCH__ >= 800
  mma_tf32(sum, a, b0, b1);
#else
  const float4 result = multiply_tile_plainly(make_float4(sum[0], sum[1], sum[2], sum[3]),
                                              make_uint4(a[0], a[1], a[2], a[3]), make_float2(b0, b1));
  sum[0] = result.x, sum[1] = result.y, sum[2] = result.z, sum[3] = result.w;
#endif
}

template <MlpPrecision kPrecision>
__device__ __forceinline__ FactorTile<kPrecision> factors(float a0, float a1, float a2, float a3) {
  FactorTile<kPrecision> tile;
  const float values[4] = {a0, a1, a2, a3};
#pragma unroll
  for (int i = 0; i < 4; ++i) {
    tile.high[i] = to_tf32(values[i]);
    if constexpr (kPrecision == MlpPrecision::kFloat32) {
      tile.low[i] = to_tf32(values[i] - __uint_as_float(tile.high[i]));
    }
  }
  return tile;
}

// An accumulator after ReLU, as the next layer's factors. NaN passes.
template <MlpPrecision kPrecision>
__device__ __forceinline__ FactorTile<kPrecision> rectified(const float (&sum)[4]) {
  float y[4];
#pragma unroll
  for (int i = 0; i < 4; ++i) y[i] = sum[i] < 0.0f ? 0.0f : sum[i];
  return factors<kPrecision>(y[0], y[2], y[1], y[3]);
}

// The encoder's parameters in shared memory. A block of 8 x 8 weights is 64 numbers, two for each lane: those it
// multiplies with.
template <MlpPrecision kPrecision>
struct EncoderWeights {
  static constexpr int kTiles = kEncoderHidden / 8;
  static constexpr int kBlock = 2 * kWarpSize;
  static constexpr int kFirst = 0, kSecond = kTiles, kThird = kSecond + kTiles * kTiles, kBlocks = kThird + kTiles;

  alignas(16) float high[kBlocks * kBlock];
  alignas(16) float low[kPrecision == MlpPrecision::kFloat32 ? kBlocks * kBlock : 1];
  alignas(16) float first_bias[kEncoderHidden], second_bias[kEncoderHidden], third_bias[kPriorFeatures];

  // By the whole block, which must synchronize afterwards.
  __device__ void load(const float* params) {
    constexpr MlpOffsets kAt = kEncoder.offsets();
    const float *w1 = params + kAt.w1, *w2 = params + kAt.w2, *w3 = params + kAt.w3;
    const float *b1 = params + kAt.b1, *b2 = params + kAt.b2, *b3 = params + kAt.b3;
    for (int i = threadIdx.x; i < kBlocks * kBlock; i += blockDim.x) {
      const int block = i / kBlock, row = i / 2 % kWarpSize / 4, column = i / 2 % 4, half = i % 2;
      // The inputs of the first layer lie in their order; hidden units as an accumulator has them.
      const int input = column + 4 * half, unit = 2 * column + half;
      float weight = 0.0f;
      if (block >= kThird) {
        weight = w3[feature_of_column(row) * kEncoderHidden + 8 * (block - kThird) + unit];
      } else if (block >= kSecond) {
        const int tile = (block - kSecond) / kTiles, step = (block - kSecond) % kTiles;
        weight = w2[(8 * tile + row) * kEncoderHidden + 8 * step + unit];
      } else if (input < kEncoderInputs) {
        weight = w1[(8 * block + row) * kEncoderInputs + input];
      }
      high[i] = __uint_as_float(to_tf32(weight));
      if constexpr (kPrecision == MlpPrecision::kFloat32) low[i] = __uint_as_float(to_tf32(weight - high[i]));
    }
    for (int i = threadIdx.x; i < kEncoderHidden; i += blockDim.x) {
      first_bias[i] = b1[i];
      second_bias[i] = b2[i];
      if (i < kPriorFeatures) third_bias[i] = b3[feature_of_column(i)];
    }
  }

  // Accumulator columns 2 q and 2 q + 1 hold features q and 4 + q: the four lanes of a row then add to neighbors.
  __device__ static int feature_of_column(int column) { return column % 2 * 4 + column / 2; }
};

__device__ __forceinline__ void set_bias(const float* bias, int lane, float (&sum)[kPairTiles][4]) {
  const float2 b = *reinterpret_cast<const float2*>(bias + 2 * (lane % 4));
#pragma unroll
  for (int m = 0; m < kPairTiles; ++m) {
    sum[m][0] = sum[m][2] = b.x;
    sum[m][1] = sum[m][3] = b.y;
  }
}

// sum += x W for both tiles and one block of weights.
template <MlpPrecision kPrecision>
__device__ __forceinline__ void multiply_block(const EncoderWeights<kPrecision>& weights, int block, int lane,
                                               const FactorTile<kPrecision> (&x)[kPairTiles],
                                               float (&sum)[kPairTiles][4]) {
  const int i = block * EncoderWeights<kPrecision>::kBlock + 2 * lane;
  const float2 high = *reinterpret_cast<const float2*>(weights.high + i);
#if defined(__CUDA_ARCH__) && __CUDA_ARCH__ >= 800
  if constexpr (kPrecision == MlpPrecision::kFloat32) {
    const float2 low = *reinterpret_cast<const float2*>(weights.low + i);
#pragma unroll
    for (int m = 0; m < kPairTiles; ++m) {
      multiply_tile(sum[m], x[m].low, high.x, high.y);
      multiply_tile(sum[m], x[m].high, low.x, low.y);
    }
  }
#endif
#pragma unroll
  for (int m = 0; m < kPairTiles; ++m) multiply_tile(sum[m], x[m].high, high.x, high.y);
}

// Features of 32 pairs: features[m][2 i + e] is feature 4 e + q of pair 16 m + 8 i + g, for lane 4 g + q. inputs[m] is
// tile m's position relative to the vertex and normal.
template <MlpPrecision kPrecision>
__device__ __forceinline__ void encode_pairs(const EncoderWeights<kPrecision>& weights,
                                             const FactorTile<kPrecision> (&inputs)[kPairTiles], int lane,
                                             float (&features)[kPairTiles][4]) {
  using Weights = EncoderWeights<kPrecision>;
  FactorTile<kPrecision> hidden[Weights::kTiles][kPairTiles];
#pragma unroll
  for (int tile = 0; tile < Weights::kTiles; ++tile) {
    float sum[kPairTiles][4];
    set_bias(weights.first_bias + 8 * tile, lane, sum);
    multiply_block(weights, Weights::kFirst + tile, lane, inputs, sum);
#pragma unroll
    for (int m = 0; m < kPairTiles; ++m) hidden[tile][m] = rectified<kPrecision>(sum[m]);
  }
  set_bias(weights.third_bias, lane, features);
#pragma unroll
  for (int tile = 0; tile < Weights::kTiles; ++tile) {
    float sum[kPairTiles][4];
    set_bias(weights.second_bias + 8 * tile, lane, sum);
#pragma unroll
    for (int step = 0; step < Weights::kTiles; ++step) {
      multiply_block(weights, Weights::kSecond + tile * Weights::kTiles + step, lane, hidden[step], sum);
    }
    FactorTile<kPrecision> units[kPairTiles];
#pragma unroll
    for (int m = 0; m < kPairTiles; ++m) units[m] = rectified<kPrecision>(sum[m]);
    multiply_block(weights, Weights::kThird + tile, lane, units, features);
  }
}

}  // namespace spslam
