// Function attributes that let one definition serve the host and the device.
#pragma once

#if defined(__CUDACC__)
#define SPS_HOST_DEVICE __host__ __device__
#define SPS_INLINE __host__ __device__ __forceinline__
#else
#define SPS_HOST_DEVICE
#define SPS_INLINE inline __attribute__((always_inline))
#endif

// SPS_SIMD, or SPS_SIMD_SUM(a, b) to name the sums it carries: the loop that follows may run in vector lanes on the
// host. SPS_UNROLL: a loop of fixed length to be unrolled on the device.
#define SPS_PRAGMA(text) _Pragma(#text)
#if defined(__CUDACC__)
#define SPS_SIMD
#define SPS_SIMD_SUM(...)
#define SPS_SIMD_MIN(...)
#define SPS_UNROLL SPS_PRAGMA(unroll)
#else
#define SPS_SIMD SPS_PRAGMA(omp simd)
#define SPS_SIMD_SUM(...) SPS_PRAGMA(omp simd reduction(+ : __VA_ARGS__))
#define SPS_SIMD_MIN(...) SPS_PRAGMA(omp simd reduction(min : __VA_ARGS__))
#define SPS_UNROLL
#endif
