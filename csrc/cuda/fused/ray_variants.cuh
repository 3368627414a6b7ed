// Defines ray_variant for the files that instantiate it.
#pragma once

#include "cuda/fused/ray_kernel.cuh"
#include "cuda/fused/ray_variants.h"

namespace spslam::fused {

template <Precision kPrecision, bool kTrain, int kWarps>
RayVariant variant_of_width() {
  return {reinterpret_cast<const void*>(&ray_kernel<kPrecision, kTrain, kWarps>), kWarps,
          static_cast<int>(sizeof(BlockMemory<kPrecision, kTrain, kWarps>))};
}

template <Precision kPrecision, bool kTrain>
RayVariant ray_variant(int architecture) {
  switch (warps_of<kPrecision, kTrain>(architecture)) {
    case 8:
      return variant_of_width<kPrecision, kTrain, 8>();
    case 4:
      return variant_of_width<kPrecision, kTrain, 4>();
    case 2:
      return variant_of_width<kPrecision, kTrain, 2>();
    default:
      return variant_of_width<kPrecision, kTrain, 1>();
  }
}

}  // namespace spslam::fused
