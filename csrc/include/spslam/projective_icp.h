// Relative camera pose by point-to-plane ICP with projective association.
#pragma once

#include <cstdint>

#include "core/device.h"
#include "spslam/gauss_newton.h"

namespace spslam {

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
std::int64_t projective_icp_workspace_size(Device device, std::int64_t num_points);

// points [num_points, 3] in the source camera's axes; pose [7] T_target_source is read and overwritten; stats
// [iterations, kTrackingStatSize], shares being of num_points; hessian [36] of the last iteration, before damping.
template <class Device>
void projective_icp(Device device, const float* points, std::int64_t num_points, const SurfaceMaps& target,
                    const IcpOptions& options, void* workspace, float* pose, float* stats, float* hessian);

}  // namespace spslam
