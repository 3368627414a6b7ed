// Device tags: every launch function takes one as its first argument and is instantiated for each.
#pragma once

namespace spslam {

struct Cpu {};

struct Cuda {
  void* stream;  // cudaStream_t, opaque so that this header needs no CUDA
};

}  // namespace spslam
