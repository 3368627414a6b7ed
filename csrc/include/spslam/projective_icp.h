// Relative camera pose by point-to-plane ICP with projective association.
#pragma once

#include <cstdint>

#include "core/device.h"
#include "spslam/gauss_newton.h"

namespace spslam {

// Points in the axes of source cameras, as many of each.
struct PointClouds {
  const float* points;  // [count, size, 3] m
  std::int64_t count, size;
};

// A surface seen by a camera: a point and its unit normal at each pixel, in camera axes.
struct SurfaceMaps {
  const float* vertices;  // [height, width, 3] m; z = 0 where there is none
  const float* normals;   // [height, width, 3]; 0 where unknown
  std::int64_t height, width;
  Intrinsics intrinsics;  // in pixels of the map
};

struct IcpOptions {
  std::int64_t iterations;
  float max_distance;              // m, between a point and its associated vertex
  float kernel_start, kernel_end;  // m, width of the robust kernel at the first and the last iterations
  double damping;
};

template <class Device>
std::int64_t projective_icp_workspace_size(Device device, const PointClouds& sources);

// Each cloud by itself: poses [count, 7] T_target_source are read and overwritten; stats [count, iterations,
// kTrackingStatSize], shares being of a cloud's size; hessians [count, 36] of the last iteration, before damping.
template <class Device>
void projective_icp(Device device, const PointClouds& sources, const SurfaceMaps& target, const IcpOptions& options,
                    void* workspace, float* poses, float* stats, float* hessians);

}  // namespace spslam
