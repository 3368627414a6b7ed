// Launches over seen points that are the same for every device.
#pragma once

#include "core/for_each.h"
#include "kernels/seen_points.h"
#include "spslam/seen_points.h"

namespace spslam {

template <class Device>
void add_seen_colors(Device device, const std::uint8_t* colors, const float* weights, std::int64_t count, float* sums) {
  for_each(device, count, [=] SPS_HOST_DEVICE(std::int64_t i) {
    if (weights[i] > 0.0f) add_seen_color(colors + 3 * i, weights[i], sums + 4 * i);
  });
}

template <class Device>
void add_color_detail(Device device, const std::uint8_t* colors, const float* weights, const SeenEdges& edges,
                      float* sums) {
  for_each(device, edges.count,
           [=] SPS_HOST_DEVICE(std::int64_t e) { add_edge_detail(colors, weights, edges, e, sums); });
}

#define SPS_INSTANTIATE_SEEN_POINTS(Device)                                                               \
  template void add_seen_colors<Device>(Device, const std::uint8_t*, const float*, std::int64_t, float*); \
  template void add_color_detail<Device>(Device, const std::uint8_t*, const float*, const SeenEdges&, float*);

}  // namespace spslam
