// Layers of a small network by one warp, in registers: 16 samples at a time, widths a multiple of 16.
//
// A tile of 16 samples and 8 J columns lies over the warp as mma.sync lays its accumulators: lane 4 g + q holds, in
// x[j], the columns 8 j + 2 q and 8 j + 2 q + 1 of sample g, then the same two of sample g + 8. The order of a layer's
// inputs is free as long as the weights follow it, so the weights are stored such that one layer's result is the next
// one's input where it lies.
#pragma once

#include <cstdint>

namespace spslam {

// kTf32 rounds the factors of a product to 10 bits of mantissa and adds in float32. Devices before sm_80 have no such
// unit and compute in float32 all the same.
enum class MlpPrecision { kFloat32, kTf32 };

constexpr int kWarpSize = 32;
constexpr int kTileSamples = 16;
constexpr unsigned kWholeWarp = 0xffffffffu;

template <MlpPrecision kPrecision>
__device__ constexpr bool on_tensor_cores() {
#if defined(__CUDA_ARCH__) && __CUDA_ARCH__ >= 800
  return kPrecision == MlpPrecision::kTf32;
#else
  return false;
#endif
}

__device__ __forceinline__ std::uint32_t to_tf32(float x) {
#if defined(__CUDA_ARCH__) && __CUDA_ARCH__ >= 800
  std::uint32_t bits;
  asm("cvt.rna.tf32.f32 %0, %1;" : "=r"(bits) : "f"(x));
  return bits;
#else
  return __float_as_uint(x);
#endif
}

// Where multiply_add looks for the weight from input k to output n.
template <MlpPrecision kPrecision, int kInputs, int kOutputs>
__device__ __forceinline__ int fragment_index(int k, int n) {
  static_assert(kInputs % 16 == 0 && kOutputs % 16 == 0, "layers are padded to multiples of 16");
  const int column = n / 8, within = n % 8;
  if constexpr (on_tensor_cores<kPrecision>()) {
    // A lane's weights of two mma's lie together, so that one 16-byte load brings both.
    const int step = k / 16, half = k % 16 / 8, lane = 4 * within + k % 8 / 2;
    return ((column * (kInputs / 16) + step) * kWarpSize + lane) * 4 + 2 * half + k % 2;
  }
  return (4 * k + within / 2) * (kOutputs / 4) + 2 * column + within % 2;
}

// Stores a weight where multiply_add looks for it, rounded as it will be read.
template <MlpPrecision kPrecision, int kInputs, int kOutputs>
__device__ __forceinline__ void store_fragment(float* weights, int k, int n, float weight) {
  if constexpr (on_tensor_cores<kPrecision>()) weight = __uint_as_float(to_tf32(weight));
  weights[fragment_index<kPrecision, kInputs, kOutputs>(k, n)] = weight;
}

__device__ __forceinline__ void mma_tf32(float (&sum)[4], const std::uint32_t (&a)[4], float b0, float b1) {
#if defined(__CUDA_ARCH__) && __CUDA_ARCH__ >= 800
  asm("mma.sync.aligned.m16n8k8.row.col.f32.tf32.tf32.f32 {%0, %1, %2, %3}, {%4, %5, %6, %7}, {%8, %9}, "
      "{%0, %1, %2, %3};"
      : "+f"(sum[0]), "+f"(sum[1]), "+f"(sum[2]), "+f"(sum[3])
      : "r"(a[0]), "r"(a[1]), "r"(a[2]), "r"(a[3]), "r"(__float_as_uint(b0)), "r"(__float_as_uint(b1)));
#endif
}

// y += x W for the whole warp; `weights` as stored by store_fragment, 16-byte aligned, best in shared memory.
template <MlpPrecision kPrecision, int kInputTiles, int kOutputTiles>
__device__ __forceinline__ void multiply_add(const float* weights, const float (&x)[kInputTiles][4],
                                             float (&y)[kOutputTiles][4], int lane) {
  if constexpr (on_tensor_cores<kPrecision>()) {
    const float4* rows = reinterpret_cast<const float4*>(weights) + lane;
#pragma unroll
    for (int step = 0; step < kInputTiles / 2; ++step) {
      std::uint32_t a[2][4];
#pragma unroll
      for (int half = 0; half < 2; ++half) {
        const float (&tile)[4] = x[2 * step + half];
        // The lane's first column of a pair goes to the first four inputs of the mma, the second to the last four.
        a[half][0] = to_tf32(tile[0]), a[half][1] = to_tf32(tile[2]);
        a[half][2] = to_tf32(tile[1]), a[half][3] = to_tf32(tile[3]);
      }
#pragma unroll
      for (int column = 0; column < kOutputTiles; ++column) {
        const float4 w = rows[(column * (kInputTiles / 2) + step) * kWarpSize];
        mma_tf32(y[column], a[0], w.x, w.y);
        mma_tf32(y[column], a[1], w.z, w.w);
      }
    }
  } else {
    const int q = lane % 4;
#pragma unroll
    for (int j = 0; j < kInputTiles; ++j) {
#pragma unroll
      for (int source = 0; source < 4; ++source) {
#pragma unroll
        for (int e = 0; e < 2; ++e) {
          const float x0 = __shfl_sync(kWholeWarp, x[j][e], source, 4);
          const float x1 = __shfl_sync(kWholeWarp, x[j][2 + e], source, 4);
          const float4* row =
              reinterpret_cast<const float4*>(weights + (4 * (8 * j + 2 * source + e) + q) * 2 * kOutputTiles);
#pragma unroll
          for (int pair = 0; pair < kOutputTiles / 2; ++pair) {
            const float4 w = row[pair];
            float (&first)[4] = y[2 * pair], (&second)[4] = y[2 * pair + 1];
            first[0] += x0 * w.x, first[1] += x0 * w.y, first[2] += x1 * w.x, first[3] += x1 * w.y;
            second[0] += x0 * w.z, second[1] += x0 * w.w, second[2] += x1 * w.z, second[3] += x1 * w.w;
          }
        }
      }
    }
  }
}

// y[*][8 j + c] = bias[8 j + c] for every sample of the tile.
template <int kTiles>
__device__ __forceinline__ void load_bias(const float* bias, float (&y)[kTiles][4], int lane) {
#pragma unroll
  for (int j = 0; j < kTiles; ++j) {
    const float2 b = *reinterpret_cast<const float2*>(bias + 8 * j + 2 * (lane % 4));
    y[j][0] = y[j][2] = b.x;
    y[j][1] = y[j][3] = b.y;
  }
}

// ReLU in place; bit 4 j + c of the result says that y[j][c] was positive.
template <int kTiles>
__device__ __forceinline__ std::uint32_t rectify(float (&y)[kTiles][4]) {
  static_assert(kTiles <= 8, "one bit a value");
  std::uint32_t active = 0;
#pragma unroll
  for (int j = 0; j < kTiles; ++j) {
#pragma unroll
    for (int c = 0; c < 4; ++c) {
      if (y[j][c] > 0.0f) active |= 1u << (4 * j + c);
      // Not fmaxf: NaN passes.
      y[j][c] = y[j][c] < 0.0f ? 0.0f : y[j][c];
    }
  }
  return active;
}

// The gradient before a ReLU whose `rectify` returned `active`, in place.
template <int kTiles>
__device__ __forceinline__ void rectify_gradient(std::uint32_t active, float (&g)[kTiles][4]) {
#pragma unroll
  for (int j = 0; j < kTiles; ++j) {
#pragma unroll
    for (int c = 0; c < 4; ++c) {
      if (!(active >> (4 * j + c) & 1u)) g[j][c] = 0.0f;
    }
  }
}

// Sum over the four lanes that share a sample; all four get it, the same to the bit.
__device__ __forceinline__ float quad_sum(float x) {
  x += __shfl_xor_sync(kWholeWarp, x, 1);
  return x + __shfl_xor_sync(kWholeWarp, x, 2);
}

// Sums 32 values a lane over the warp, in a fixed tree: lane i returns the total of values[i], which are spent.
template <int kWidth = kWarpSize / 2>
__device__ __forceinline__ float transpose_sum(float (&values)[kWarpSize], int lane) {
  const bool upper = lane & kWidth;
#pragma unroll
  for (int i = 0; i < kWidth; ++i) {
    const float sent = upper ? values[i] : values[i + kWidth];
    const float kept = upper ? values[i + kWidth] : values[i];
    values[i] = kept + __shfl_xor_sync(kWholeWarp, sent, kWidth);
  }
  if constexpr (kWidth > 1) return transpose_sum<kWidth / 2>(values, lane);
  return values[0];
}

}  // namespace spslam
