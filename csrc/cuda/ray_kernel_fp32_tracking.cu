#include "cuda/fused/ray_variants.cuh"

namespace spslam::fused {

template RayVariant ray_variant<Precision::kFp32, false>(int);

}  // namespace spslam::fused
