// Which points of a surface a frame sees, with which colors, and how many of its pixels each point has; sums of such
// colors over frames, and what they say of detail between points.
#pragma once

#include <cstdint>

#include "core/device.h"
#include "core/macros.h"
#include "spslam/types/camera.h"
#include "spslam/types/depth_noise.h"

namespace spslam {

// Points with a common bounding sphere: they are looked for in a frame together.
constexpr int kSeenRun = 1024;

// Points and their unit normals [count, 3], world, and a sphere around each kSeenRun of them: center and radius
// [ceil(count / kSeenRun), 4], m.
struct SeenSurface {
  const float *points, *normals, *spheres;
  std::int64_t count;
};

// Depth [height, width] (m, 0 where unknown), color [height, width, 3] and pose [7].
struct SeenFrame {
  const float* depth;
  const std::uint8_t* colors;
  const float* pose;
  std::int32_t width, height;
  Intrinsics camera;
  DepthNoise noise;
};

// Colors [count, 3] with which the frame sees the points, and weights [count]: its pixels per area of surface, 1/m^2.
// Both are 0 of points that it does not see.
inline std::int64_t see_points_workspace_bytes(const SeenFrame& frame) {
  return 2 * (std::int64_t{frame.width} + 2) * (std::int64_t{frame.height} + 2) *
         static_cast<std::int64_t>(sizeof(float));
}
template <class Device>
void see_points(Device device, const SeenSurface& surface, const SeenFrame& frame, std::uint8_t* colors, float* weights,
                void* workspace);

// Adds weighted colors [count, 3] and their weights to sums [count, 4].
template <class Device>
void add_seen_colors(Device device, const std::uint8_t* colors, const float* weights, std::int64_t count, float* sums);

// Edges between points: `ends` [count, 2] are their places, and the middle of edge e has place first_middle + e.
struct SeenEdges {
  const std::int64_t* ends;
  std::int64_t count, first_middle;
};

// Where a frame sees both ends and the middle of an edge: adds to [count, 5] the difference (red, green, blue) between
// the middle's color and the mean of the ends', its square, and 1.
template <class Device>
void add_color_detail(Device device, const std::uint8_t* colors, const float* weights, const SeenEdges& edges,
                      float* sums);

}  // namespace spslam
