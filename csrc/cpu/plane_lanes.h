// Planes of several pixels as one array per number, for loops over vector lanes.
#pragma once

#include <cstdint>

#include "cpu/simd.h"
#include "kernels/depth_planes.h"

namespace spslam {

template <int Lanes>
struct PlaneLanes {
  alignas(64) float x[Lanes], y[Lanes], z[Lanes], distance[Lanes], weight[Lanes];

  // pixel_of(m) is the pixel of lane m, -1 for none, whose plane is all 0. Copied one by one: gathers of vectors are
  // slower on many processors.
  template <class PixelOf>
  void load(const float* planes, const PixelOf& pixel_of) {
    static constexpr float kNothing[kPlaneSize] = {};
    for (int m = 0; m < Lanes; ++m) {
      const std::int64_t pixel = pixel_of(m);
      const float* plane = pixel < 0 ? kNothing : planes + kPlaneSize * pixel;
      x[m] = plane[0];
      y[m] = plane[1];
      z[m] = plane[2];
      distance[m] = plane[3];
      weight[m] = plane[4];
    }
  }

  MeasuredPlane operator[](int m) const { return {{x[m], y[m], z[m]}, distance[m], weight[m]}; }
};

}  // namespace spslam
