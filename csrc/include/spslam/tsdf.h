// A truncated signed distance field on sparse blocks of voxels: planes measured by a depth image, the blocks that they
// touch, their integration, and lookup at points and along rays.
//
// Voxel (i, j, k) of block b lies at (8 b + (i, j, k)) voxel_size; it is element (8 i + j) 8 + k of the block's row.
#pragma once

#include <cstdint>

#include "core/device.h"
#include "core/macros.h"
#include "spslam/prior_fusion.h"
#include "spslam/types/camera.h"
#include "spslam/types/depth_noise.h"
#include "spslam/types/voxel_table.h"

namespace spslam {

constexpr int kTsdfBlockSide = 8;
constexpr int kTsdfBlockVoxels = kTsdfBlockSide * kTsdfBlockSide * kTsdfBlockSide;
// Numbers of a measured plane: unit normal away from the camera (x, y, z, camera axes), distance (m) from the camera
// and weight. Weight 0 says that nothing was measured.
constexpr int kPlaneSize = 5;
// Red, green and blue in 1/256, and their weight in 1/kColorWeightUnit.
constexpr int kTsdfColorSize = 4;
// Blocks that a pixel's surface may touch, as samples along its ray.
constexpr int kTouchedPerPixel = 6;
// Edge of the image tiles whose farthest surface is known, px.
constexpr int kTsdfTileSide = 16;
// First coordinate of rows that name no block.
constexpr std::int32_t kNoBlock = INT32_MIN;

// Planes [height, width, kPlaneSize] measured by a frame, its colors [height, width, 3] or null, and pose [7].
struct PlaneFrame {
  const float* planes;
  const std::uint8_t* colors;
  const float* pose;
  std::int32_t width, height;
  Intrinsics camera;
};

// Arrays of `count` blocks: coordinates [count, 3], and [count, 512] distances (m) and weights, [count, 512, 4] colors.
struct TsdfBlocks {
  const std::int32_t* coords;
  float* sdf;
  float* weights;
  std::uint16_t* colors;
  std::int64_t count;
  float voxel_size;
};

// The truncation at a depth is `near_truncation` and a deviation of the noise, at most `truncation`, m; or two
// deviations where that is more, at most 0.2 m (kTruncationDeviations, kMostNoiseTruncation).
struct TsdfOptions {
  float truncation, near_truncation;
  DepthNoise noise;
  float max_weight;
};

// Which blocks are touched; `truncation` and `noise` as of `TsdfOptions`.
struct TouchOptions {
  float voxel_size, truncation;
  DepthNoise noise;
  std::int32_t step;
};

// A field that is only read, and the weight from which a voxel counts as known; one without any never does.
struct TsdfView {
  VoxelTable table;
  const float* sdf;
  const float* weights;
  const std::uint16_t* colors;
  std::int64_t count;  // of blocks; what the table names beyond them is not there
  float voxel_size, min_weight;
};

// The noise of depth that planes are fitted to. Where a sensor smoothed depth, neighbors share theirs: a mean over them
// takes nothing from it, so the fit goes by the depth as it is, and only the weight counts the noise.
struct PlaneNoise {
  DepthNoise depth;
  bool is_shared;
};

// The plane around each pixel of a depth image.
template <class Device>
void measure_planes(Device device, const DepthImage& image, const PlaneNoise& noise, float* planes);

// Coordinates [touched_rows(frame, step), 3] of the blocks within the truncation of the planes of every step-th pixel,
// or within two deviations of the noise, see `TsdfOptions`; with repetitions; kNoBlock in rows without one. Returns how
// many rows it wrote, from the first one on: all of them on CUDA, where it does not wait for the device.
inline std::int64_t touched_rows(const PlaneFrame& frame, std::int32_t step) {
  const std::int64_t columns = (frame.width + step - 1) / step, rows = (frame.height + step - 1) / step;
  return kTouchedPerPixel * columns * rows;
}
template <class Device>
std::int64_t tsdf_touched_blocks(Device device, const PlaneFrame& frame, const TouchOptions& options,
                                 std::int32_t* coords);

inline std::int64_t tsdf_missing_workspace_bytes(std::int64_t n) {
  return (n + 1) * static_cast<std::int64_t>(sizeof(std::int32_t));
}
// Copies to `missing` [n, 3] those of n rows of block coordinates that are blocks and not in a table, in no particular
// order; returns how many there are, for which it waits.
template <class Device>
std::int64_t tsdf_missing_blocks(Device device, const VoxelTable& table, const std::int32_t* coords, std::int64_t n,
                                 void* workspace, std::int32_t* missing);

// Adds a frame to all blocks that it sees.
SPS_INLINE std::int32_t tiles_along(std::int32_t size) {
  return (size + kTsdfTileSide - 1) / kTsdfTileSide;
}
inline std::int64_t tsdf_integrate_workspace_bytes(const PlaneFrame& frame) {
  const std::int64_t tiles = static_cast<std::int64_t>(tiles_along(frame.width)) * tiles_along(frame.height);
  return tiles * static_cast<std::int64_t>(sizeof(float));
}
template <class Device>
void tsdf_integrate(Device device, const TsdfBlocks& blocks, const PlaneFrame& frame, const TsdfOptions& options,
                    void* workspace);

// Trilinear distance [n] (m) and color [n, 3] in [0, 1] at world points; known[n] where all eight voxels around are.
template <class Device>
void tsdf_query(Device device, const TsdfView& view, const float* points, std::int64_t n, float* sdf, float* colors,
                bool* known);

struct RayCastCamera {
  const float* pose;
  std::int32_t width, height;
  Intrinsics camera;
  float near, far;  // depth, m
};

// Depth [height, width] (m, 0 without surface), unit normals in world axes [height, width, 3] and colors of the first
// surface on each pixel's ray that is seen from its front.
template <class Device>
void tsdf_ray_cast(Device device, const TsdfView& view, const RayCastCamera& camera, float* depth, float* normals,
                   float* colors);

}  // namespace spslam
