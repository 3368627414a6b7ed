// Function attributes that let one definition serve the host and the device.
#pragma once

#if defined(__CUDACC__)
#define SPS_HOST_DEVICE __host__ __device__
#define SPS_INLINE __host__ __device__ __forceinline__
#else
#define SPS_HOST_DEVICE
#define SPS_INLINE inline __attribute__((always_inline))
#endif
