// Products of 16 x 8 tiles by one warp on tensor cores (mma.sync), for the depth encoder; fused/fragment.cuh has whole
// layers of the decoders.
#pragma once

#include <cstdint>

namespace spslam {

// kTf32 rounds the factors of a product to 10 bits of mantissa and adds in float32. Devices before sm_80 have no
// such tensor cores and compute in float32.
enum class MlpPrecision { kFloat32, kTf32 };

constexpr int kWarpSize = 32;
constexpr int kTileSamples = 16;
constexpr unsigned kWholeWarp = 0xffffffffu;

__device__ __forceinline__ std::uint32_t to_tf32(float x) {
#if defined(__CUDA_ARCH__) && __CUDA_ARCH__ >= 800
  std::uint32_t bits;
  asm("cvt.rna.tf32.f32 %0, %1;" : "=r"(bits) : "f"(x));
  return bits;
#else
  return __float_as_uint(x);
#endif
}

__device__ __forceinline__ void mma_tf32(float (&sum)[4], const std::uint32_t (&a)[4], float b0, float b1) {
#if defined(__CUDA_ARCH__) && __CUDA_ARCH__ >= 800
  asm("mma.sync.aligned.m16n8k8.row.col.f32.tf32.tf32.f32 {%0, %1, %2, %3}, {%4, %5, %6, %7}, {%8, %9}, "
      "{%0, %1, %2, %3};"
      : "+f"(sum[0]), "+f"(sum[1]), "+f"(sum[2]), "+f"(sum[3])
      : "r"(a[0]), "r"(a[1]), "r"(a[2]), "r"(a[3]), "r"(__float_as_uint(b0)), "r"(__float_as_uint(b1)));
#endif
}

}  // namespace spslam
