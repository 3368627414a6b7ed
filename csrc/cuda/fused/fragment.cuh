// A tile of 16 samples in the registers of a warp, and the layers of the decoders on it.
//
// A fragment float[N][4] holds a 16 x 8N matrix the way mma.sync returns it: with g = lane / 4 and q = lane % 4,
// element [j][2 r + e] is row g + 8 r, column 8 j + 2 q + e. The columns of a product may be taken in any order as long
// as both operands agree, so the result of one layer is an operand of the next as it is.
#pragma once

#include <cuda_bf16.h>
#include <cuda_runtime.h>

#include <cstdint>

#include "core/vec.h"
#include "spslam/render_step.h"

namespace spslam::fused {

constexpr int kWarp = 32;
constexpr unsigned kAllLanes = 0xffffffffu;
constexpr int kTileRows = 16;

// The compute capability that device code is compiled for, as in __CUDA_ARCH__.
#if defined(__CUDA_ARCH__)
constexpr int kArchitecture = __CUDA_ARCH__;
#else
constexpr int kArchitecture = 0;
#endif
// Tensor cores for tf32 and bf16.
constexpr int kTensorArchitecture = 800;

__device__ __forceinline__ int lane_row(int lane) {
  return lane >> 2;
}
__device__ __forceinline__ int lane_quad(int lane) {
  return lane & 3;
}

__device__ __forceinline__ float round_to_tf32(float x) {
  std::uint32_t bits = __float_as_uint(x);
#if defined(__CUDA_ARCH__) && __CUDA_ARCH__ >= 800
  asm("cvt.rna.tf32.f32 %0, %1;" : "=r"(bits) : "f"(x));
#endif
  return __uint_as_float(bits);
}

// c += a b: 16 x 8 += 16 x 8 times 8 x 8 in tf32.
__device__ __forceinline__ void mma_tf32(float (&c)[4], const float (&a)[4], float b0, float b1) {
#if defined(__CUDA_ARCH__) && __CUDA_ARCH__ >= 800
  asm volatile(
      "mma.sync.aligned.m16n8k8.row.col.f32.tf32.tf32.f32 {%0,%1,%2,%3}, {%4,%5,%6,%7}, {%8,%9}, {%0,%1,%2,%3};"
      : "+f"(c[0]), "+f"(c[1]), "+f"(c[2]), "+f"(c[3])
      : "r"(__float_as_uint(a[0])), "r"(__float_as_uint(a[1])), "r"(__float_as_uint(a[2])), "r"(__float_as_uint(a[3])),
        "r"(__float_as_uint(b0)), "r"(__float_as_uint(b1)));
#endif
}

// c += a b: 16 x 8 += 16 x 16 times 16 x 8 in bf16.
__device__ __forceinline__ void mma_bf16(float (&c)[4], const std::uint32_t (&a)[4], std::uint32_t b0,
                                         std::uint32_t b1) {
#if defined(__CUDA_ARCH__) && __CUDA_ARCH__ >= 800
  asm volatile(
      "mma.sync.aligned.m16n8k16.row.col.f32.bf16.bf16.f32 {%0,%1,%2,%3}, {%4,%5,%6,%7}, {%8,%9}, {%0,%1,%2,%3};"
      : "+f"(c[0]), "+f"(c[1]), "+f"(c[2]), "+f"(c[3])
      : "r"(a[0]), "r"(a[1]), "r"(a[2]), "r"(a[3]), "r"(b0), "r"(b1));
#endif
}

// Where element (k, n) of a K x N matrix lies in shared memory, so that a lane reads its share 16 bytes at a time.
template <Precision kPrecision>
__host__ __device__ constexpr int fragment_index(int k, int n, int K, int N) {
  if (kPrecision == Precision::kFp32) {
    const int column = n >> 3, quad = (n & 7) >> 1, odd = n & 1;
    return (k * 4 + quad) * (N / 8) * 2 + column * 2 + odd;
  }
  const int column = n >> 3, row = n & 7, step = k >> 4, half = (k & 15) >> 3, quad = (k & 7) >> 1, odd = k & 1;
  return ((column * (K / 16) + step) * kWarp + row * 4 + quad) * 4 + half * 2 + odd;
}

// y += x w with x 16 x 8 KT, w 8 KT x 8 NT as `fragment_index` lays it out.
template <Precision kPrecision, int KT, int NT>
__device__ __forceinline__ void layer(const float* w, const float (&x)[KT][4], float (&y)[NT][4], int lane) {
  if constexpr (kPrecision == Precision::kFp32) {
#pragma unroll
    for (int k = 0; k < 8 * KT; ++k) {
      const int tile = k >> 3, quad = (k & 7) >> 1, odd = k & 1;
      const float low = __shfl_sync(kAllLanes, x[tile][odd], quad, 4);
      const float high = __shfl_sync(kAllLanes, x[tile][2 + odd], quad, 4);
      const float4* row = reinterpret_cast<const float4*>(w + (k * 4 + lane_quad(lane)) * NT * 2);
#pragma unroll
      for (int j = 0; j < NT; j += 2) {
        const float4 v = row[j / 2];
        y[j][0] += low * v.x, y[j][1] += low * v.y, y[j][2] += high * v.x, y[j][3] += high * v.y;
        y[j + 1][0] += low * v.z, y[j + 1][1] += low * v.w, y[j + 1][2] += high * v.z, y[j + 1][3] += high * v.w;
      }
    }
  } else {
    const float4* fragments = reinterpret_cast<const float4*>(w);
#pragma unroll
    for (int t = 0; t < KT / 2; ++t) {
      const float a[4] = {round_to_tf32(x[2 * t][0]), round_to_tf32(x[2 * t][2]), round_to_tf32(x[2 * t][1]),
                          round_to_tf32(x[2 * t][3])};
      const float b[4] = {round_to_tf32(x[2 * t + 1][0]), round_to_tf32(x[2 * t + 1][2]),
                          round_to_tf32(x[2 * t + 1][1]), round_to_tf32(x[2 * t + 1][3])};
#pragma unroll
      for (int j = 0; j < NT; ++j) {
        const float4 v = fragments[(j * (KT / 2) + t) * kWarp + lane];
        mma_tf32(y[j], a, v.x, v.y);
        mma_tf32(y[j], b, v.z, v.w);
      }
    }
  }
}

// Adds a bias, or starts a sum with it.
template <int NT>
__device__ __forceinline__ void fill_columns(float (&y)[NT][4], const float* columns, int lane) {
#pragma unroll
  for (int j = 0; j < NT; ++j) {
    const float2 b = *reinterpret_cast<const float2*>(columns + 8 * j + 2 * lane_quad(lane));
    y[j][0] = y[j][2] = b.x;
    y[j][1] = y[j][3] = b.y;
  }
}

// ReLU in place; returns a bit for each element that passed. NaN passes.
template <int NT>
__device__ __forceinline__ std::uint32_t rectify(float (&y)[NT][4]) {
  std::uint32_t passed = 0;
#pragma unroll
  for (int j = 0; j < NT; ++j) {
#pragma unroll
    for (int k = 0; k < 4; ++k) {
      if (y[j][k] <= 0.0f) {
        y[j][k] = 0.0f;
      } else {
        passed |= 1u << (4 * j + k);
      }
    }
  }
  return passed;
}

// Back through the ReLU.
template <int NT>
__device__ __forceinline__ void mask(float (&y)[NT][4], std::uint32_t passed) {
#pragma unroll
  for (int j = 0; j < NT; ++j) {
#pragma unroll
    for (int k = 0; k < 4; ++k) y[j][k] = passed >> (4 * j + k) & 1 ? y[j][k] : 0.0f;
  }
}

// Sum over the four lanes that share a row.
__device__ __forceinline__ float sum_quad(float v) {
  v += __shfl_xor_sync(kAllLanes, v, 1);
  return v + __shfl_xor_sync(kAllLanes, v, 2);
}

__device__ __forceinline__ float sum_warp(float v) {
#pragma unroll
  for (int offset = kWarp / 2; offset; offset /= 2) v += __shfl_xor_sync(kAllLanes, v, offset);
  return v;
}

__device__ __forceinline__ Vec3<float> sum_warp(const Vec3<float>& v) {
  return {sum_warp(v.x), sum_warp(v.y), sum_warp(v.z)};
}

__device__ __forceinline__ float min_warp(float v) {
#pragma unroll
  for (int offset = kWarp / 2; offset; offset /= 2) v = fminf(v, __shfl_xor_sync(kAllLanes, v, offset));
  return v;
}

// Rows g and g + 8 of y . w, for each of the warp's row pairs; every lane of a row gets the sum.
__device__ __forceinline__ void dot_rows(const float (&y)[4][4], const float* w, int lane, float (&rows)[2]) {
  rows[0] = rows[1] = 0.0f;
#pragma unroll
  for (int j = 0; j < 4; ++j) {
    const float2 v = *reinterpret_cast<const float2*>(w + 8 * j + 2 * lane_quad(lane));
    rows[0] += y[j][0] * v.x + y[j][1] * v.y;
    rows[1] += y[j][2] * v.x + y[j][3] * v.y;
  }
  rows[0] = sum_quad(rows[0]);
  rows[1] = sum_quad(rows[1]);
}

}  // namespace spslam::fused
