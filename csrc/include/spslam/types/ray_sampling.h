// How the samples along a ray are placed (section III-B).
#pragma once

#include <cstdint>

#include "core/macros.h"

namespace spslam {

// Samples s = 0 .. num_uniform-1 are stratified between near and far times the measured depth, the num_surface that
// follow within the truncation distance of it.
template <class T>
struct RaySampling {
  std::int32_t num_uniform, num_surface;
  T near, far;   // shares of the measured depth
  T truncation;  // m

  SPS_INLINE std::int32_t num_samples() const { return num_uniform + num_surface; }
};

}  // namespace spslam
