// The voxel hash table as kernels read it, and the range of voxel coordinates.
#pragma once

#include <cstdint>

namespace spslam {

constexpr int kVoxelCoordBits = 21;
constexpr std::int32_t kVoxelCoordMax = (1 << (kVoxelCoordBits - 1)) - 1;
constexpr std::int32_t kVoxelCoordMin = -kVoxelCoordMax - 1;
constexpr std::int64_t kEmptyVoxelKey = -1;
constexpr std::int32_t kNoVoxel = -1;
constexpr int kCellCorners = 8;

// A hash table that is only read: slot i holds keys[i] -> values[i]. mask is its capacity, a power of two, minus one.
struct VoxelTable {
  const std::int64_t* keys;
  const std::int32_t* values;
  std::int64_t mask;
};

}  // namespace spslam
