// Marching cubes over a sparse set of cells, with one vertex for each crossed edge, shared between cells.
#pragma once

#include <cstdint>

#include "core/device.h"

namespace spslam {

// `count` cells with distinct integer coordinates [count, 3] in [-2^20, 2^20 - 1]. Each is cut into n x n x n cubes and
// has values [count, n + 1, n + 1, n + 1], x slowest, z fastest. A value that is not finite is unknown.
struct MarchingCubesCells {
  const std::int32_t* coords;
  const float* values;
  std::int64_t count;
  int n;
  float level;
};

constexpr std::uint64_t kCoordOutOfRange = 1, kCoordRepeated = 2;

struct MarchingCubesCounts {
  std::int64_t vertices, faces;
  std::uint64_t faults;  // of the coordinates: kCoordOutOfRange, kCoordRepeated; the counts are then undefined
};

// Bytes of workspace for `count` cells of n x n x n cubes.
template <class Device>
std::int64_t marching_cubes_workspace_bytes(Device device, std::int64_t count, int n);

// Finds the surface and counts its vertices and faces. Waits for the device.
template <class Device>
MarchingCubesCounts marching_cubes_count(Device device, const MarchingCubesCells& cells, void* workspace);

// Writes vertices [vertices, 3] in cell units and faces [faces, 3], from the workspace that marching_cubes_count left.
template <class Device>
void marching_cubes_fill(Device device, const MarchingCubesCells& cells, void* workspace, float* vertices,
                         std::int64_t* faces);

}  // namespace spslam
