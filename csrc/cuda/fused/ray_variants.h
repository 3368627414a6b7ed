// The ray kernel's variants, each compiled in a file of its own.
#pragma once

#include "spslam/render_step.h"

namespace spslam::fused {

// One variant on the current device.
struct RayVariant {
  const void* kernel;
  int warps, shared_bytes;
};

// `architecture`: what the device's code was compiled for.
template <Precision kPrecision, bool kTrain>
RayVariant ray_variant(int architecture);

extern template RayVariant ray_variant<Precision::kTf32, true>(int);
extern template RayVariant ray_variant<Precision::kFp32, true>(int);
extern template RayVariant ray_variant<Precision::kTf32, false>(int);
extern template RayVariant ray_variant<Precision::kFp32, false>(int);

}  // namespace spslam::fused
