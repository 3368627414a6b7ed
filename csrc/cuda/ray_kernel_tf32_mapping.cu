#include "cuda/fused/ray_variants.cuh"

namespace spslam::fused {

template RayVariant ray_variant<Precision::kTf32, true>(int);

}  // namespace spslam::fused
