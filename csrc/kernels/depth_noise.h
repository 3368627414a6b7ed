// The variance of a depth.
#pragma once

#include "core/macros.h"
#include "spslam/types/depth_noise.h"

namespace spslam {

// m^2, of a depth in m.
SPS_INLINE float depth_variance(const DepthNoise& noise, float depth) {
  const float squared = depth * depth;
  return noise.floor + noise.growth * squared * squared;
}

}  // namespace spslam
