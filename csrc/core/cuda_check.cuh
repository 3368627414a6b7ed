// CUDA runtime calls that throw on failure, so that a binding reports them as an error of the op.
#pragma once

#include <cuda_runtime.h>

#include <stdexcept>
#include <string>

#define SPS_CUDA_CHECK(call)                                                                           \
  do {                                                                                                 \
    const cudaError_t sps_status = (call);                                                             \
    if (sps_status != cudaSuccess)                                                                     \
      throw std::runtime_error(std::string("CUDA: ") + cudaGetErrorString(sps_status) + " in " #call); \
  } while (0)
