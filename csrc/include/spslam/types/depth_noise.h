// The noise of depth.
#pragma once

namespace spslam {

// Variance of a depth z: floor + growth z^4, m^2.
struct DepthNoise {
  float floor, growth;  // m^2, 1/m^2
};

}  // namespace spslam
