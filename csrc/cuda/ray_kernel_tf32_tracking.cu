#include "cuda/fused/ray_variants.cuh"

namespace spslam::fused {

template RayVariant ray_variant<Precision::kTf32, false>(int);

}  // namespace spslam::fused
