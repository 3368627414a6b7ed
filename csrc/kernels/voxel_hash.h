// The voxel hash: packed coordinates, open addressing with linear probing, and the cell around a point.
#pragma once

#include <cmath>
#include <cstdint>

#include "core/macros.h"
#include "core/vec.h"
#include "spslam/types/voxel_table.h"

namespace spslam {

struct VoxelCoord {
  std::int32_t x, y, z;
};

SPS_INLINE VoxelCoord load_voxel(const std::int32_t* coords, std::int64_t i) {
  return {coords[3 * i], coords[3 * i + 1], coords[3 * i + 2]};
}

// Corner k of the cell whose lowest corner is c.
SPS_INLINE VoxelCoord cell_corner(VoxelCoord c, int k) {
  return {c.x + (k & 1), c.y + ((k >> 1) & 1), c.z + ((k >> 2) & 1)};
}

SPS_INLINE bool voxel_in_range(VoxelCoord c) {
  return c.x >= kVoxelCoordMin && c.x <= kVoxelCoordMax && c.y >= kVoxelCoordMin && c.y <= kVoxelCoordMax &&
         c.z >= kVoxelCoordMin && c.z <= kVoxelCoordMax;
}

// A coordinate counted from the lowest one; unsigned, so that one out of range is a wrong number and nothing worse.
SPS_INLINE std::uint64_t voxel_axis_bits(std::int32_t c) {
  return static_cast<std::uint32_t>(c) - static_cast<std::uint32_t>(kVoxelCoordMin);
}

// 21 bits per axis, so that the order of keys is the lexicographic order of (x, y, z). Out of range: some key.
SPS_INLINE std::int64_t pack_voxel(VoxelCoord c) {
  return static_cast<std::int64_t>((voxel_axis_bits(c.x) << (2 * kVoxelCoordBits)) |
                                   (voxel_axis_bits(c.y) << kVoxelCoordBits) | voxel_axis_bits(c.z));
}

SPS_INLINE VoxelCoord unpack_voxel(std::int64_t key) {
  constexpr std::int64_t kAxisMask = (1 << kVoxelCoordBits) - 1;
  return {static_cast<std::int32_t>(key >> (2 * kVoxelCoordBits)) + kVoxelCoordMin,
          static_cast<std::int32_t>((key >> kVoxelCoordBits) & kAxisMask) + kVoxelCoordMin,
          static_cast<std::int32_t>(key & kAxisMask) + kVoxelCoordMin};
}

// Folds the x bits down before the multiplication: the slot is taken from the middle of the product, which the top
// bits of the key would not reach.
SPS_INLINE std::int64_t voxel_slot(std::int64_t key, std::int64_t mask) {
  std::uint64_t h = static_cast<std::uint64_t>(key);
  h ^= h >> 32;
  h *= 0xFF51AFD7ED558CCDull;
  return static_cast<std::int64_t>(h >> 32) & mask;
}

// Id of a packed coordinate, or kNoVoxel. In a table that is at most half full, as all should be, a probe soon meets an
// empty slot; in one without any it ends where it began.
SPS_INLINE std::int32_t find_voxel_key(const VoxelTable& table, std::int64_t key) {
  const std::int64_t first = voxel_slot(key, table.mask);
  std::int64_t slot = first;
  do {
    const std::int64_t found = table.keys[slot];
    if (found == key) return table.values[slot];
    if (found == kEmptyVoxelKey) return kNoVoxel;
    slot = (slot + 1) & table.mask;
  } while (slot != first);
  return kNoVoxel;
}

// Id of a coordinate, or kNoVoxel where it is absent or out of range.
SPS_INLINE std::int32_t find_voxel(const VoxelTable& table, VoxelCoord c) {
  return voxel_in_range(c) ? find_voxel_key(table, pack_voxel(c)) : kNoVoxel;
}

// Writes the ids of the eight corners of the cell at c; returns whether all exist. Where one is missing all are
// written as kNoVoxel, so that a reader need look at the first only.
SPS_INLINE bool gather_corners(const VoxelTable& table, VoxelCoord c, std::int32_t* corners) {
  bool complete = true;
  for (int k = 0; k < kCellCorners; ++k) {
    corners[k] = complete ? find_voxel(table, cell_corner(c, k)) : kNoVoxel;
    complete = complete && corners[k] != kNoVoxel;
  }
  if (complete) return true;
  for (int k = 0; k < kCellCorners; ++k) corners[k] = kNoVoxel;
  return false;
}

// Where a point lies: corner_ids is null outside the allocated cells, else the row of its cell's eight corners; local
// is the position within the cell, in [0, 1].
template <class T>
struct Cell {
  const std::int32_t* corner_ids;
  Vec3<T> local;
};

// Packed coordinate of the cell whose lowest corner is `base`, of whole numbers; kEmptyVoxelKey for NaN and out of
// range.
template <class T>
SPS_INLINE std::int64_t cell_key(const Vec3<T>& base) {
  constexpr T kLow = static_cast<T>(kVoxelCoordMin), kHigh = static_cast<T>(kVoxelCoordMax);
  const bool in_range =
      base.x >= kLow && base.x <= kHigh && base.y >= kLow && base.y <= kHigh && base.z >= kLow && base.z <= kHigh;
  if (!in_range) return kEmptyVoxelKey;
  return pack_voxel(
      {static_cast<std::int32_t>(base.x), static_cast<std::int32_t>(base.y), static_cast<std::int32_t>(base.z)});
}

// The cell whose lowest corner has that id, which may be kNoVoxel, around a point that is at `local` in it. A vertex
// beyond the rows of corner ids, as of rows from before an insertion, has none.
template <class T>
SPS_INLINE Cell<T> cell_of_voxel(const std::int32_t* corner_ids, std::int64_t rows, std::int32_t id,
                                 const Vec3<T>& local) {
  const bool known = id >= 0 && id < rows;
  const std::int32_t* row = known ? corner_ids + static_cast<std::int64_t>(kCellCorners) * id : nullptr;
  if (!row || row[0] == kNoVoxel) return {nullptr, {T(0), T(0), T(0)}};
  return {row, local};
}

template <class T>
SPS_INLINE Vec3<T> rounded_down(const Vec3<T>& v) {
  return {std::floor(v.x), std::floor(v.y), std::floor(v.z)};
}

// The cell around a point given in voxel units (world point / voxel size). One probe: the row beside the lowest corner
// names the other seven. NaN and far away points are outside.
template <class T>
SPS_INLINE Cell<T> find_cell(const VoxelTable& table, const std::int32_t* corner_ids, std::int64_t rows,
                             const Vec3<T>& point_vox) {
  const Vec3<T> base = rounded_down(point_vox);
  const std::int64_t key = cell_key(base);
  const std::int32_t id = key == kEmptyVoxelKey ? kNoVoxel : find_voxel_key(table, key);
  return cell_of_voxel(corner_ids, rows, id, point_vox - base);
}

}  // namespace spslam
