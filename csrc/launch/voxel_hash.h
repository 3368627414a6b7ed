// Launches of voxel_hash that are the same for every device.
#pragma once

#include "core/for_each.h"
#include "kernels/voxel_hash.h"
#include "spslam/voxel_hash.h"

namespace spslam {

template <class Device>
void voxel_hash_pack(Device device, const std::int32_t* voxel_coords, std::int64_t n, std::int64_t* keys) {
  for_each(device, n, [=] SPS_HOST_DEVICE(std::int64_t i) { keys[i] = pack_voxel(load_voxel(voxel_coords, i)); });
}

template <class Device>
void voxel_hash_unpack(Device device, const std::int64_t* keys, std::int64_t n, std::int32_t* voxel_coords) {
  for_each(device, n, [=] SPS_HOST_DEVICE(std::int64_t i) {
    const VoxelCoord c = unpack_voxel(keys[i]);
    voxel_coords[3 * i] = c.x;
    voxel_coords[3 * i + 1] = c.y;
    voxel_coords[3 * i + 2] = c.z;
  });
}

template <class Device>
void voxel_hash_find(Device device, const std::int64_t* hash_keys, const std::int32_t* hash_values,
                     std::int64_t capacity, const std::int32_t* voxel_coords, std::int64_t n, std::int32_t* voxel_ids) {
  const VoxelTable table{hash_keys, hash_values, capacity - 1};
  for_each(device, n,
           [=] SPS_HOST_DEVICE(std::int64_t i) { voxel_ids[i] = find_voxel(table, load_voxel(voxel_coords, i)); });
}

// Updates the row of the cell whose corner k is the new vertex `id`, if it is this vertex's to update: its own row, or
// an older row of which it is the first new corner. So every row has one writer.
SPS_INLINE void update_corner_row(const VoxelTable& table, VoxelCoord vertex, std::int64_t first_new, int k,
                                  std::int32_t id, std::int32_t* corner_ids) {
  const VoxelCoord lowest{vertex.x - (k & 1), vertex.y - ((k >> 1) & 1), vertex.z - ((k >> 2) & 1)};
  const std::int32_t row = k == 0 ? id : find_voxel(table, lowest);
  if (row == kNoVoxel || (k != 0 && row >= first_new)) return;
  std::int32_t corners[kCellCorners];
  const bool complete = gather_corners(table, lowest, corners);
  if (k != 0) {
    if (!complete) return;  // it was all kNoVoxel before and stays so
    for (int j = 0; j < k; ++j) {
      if (corners[j] >= first_new) return;
    }
  }
  for (int j = 0; j < kCellCorners; ++j) corner_ids[static_cast<std::int64_t>(kCellCorners) * row + j] = corners[j];
}

template <class Device>
void voxel_hash_update_corner_ids(Device device, const std::int64_t* hash_keys, const std::int32_t* hash_values,
                                  std::int64_t capacity, const std::int32_t* voxel_coords, std::int64_t num_voxels,
                                  std::int64_t first_new, std::int32_t* corner_ids) {
  const VoxelTable table{hash_keys, hash_values, capacity - 1};
  for_each(device, num_voxels - first_new, [=] SPS_HOST_DEVICE(std::int64_t i) {
    const std::int32_t id = static_cast<std::int32_t>(first_new + i);
    const VoxelCoord vertex = load_voxel(voxel_coords, id);
    if (!voxel_in_range(vertex)) {  // no table holds it
      for (int k = 0; k < kCellCorners; ++k) corner_ids[static_cast<std::int64_t>(kCellCorners) * id + k] = kNoVoxel;
      return;
    }
    for (int k = 0; k < kCellCorners; ++k) update_corner_row(table, vertex, first_new, k, id, corner_ids);
  });
}

template <class Device, class T>
void voxel_hash_lookup(Device device, const std::int64_t* hash_keys, const std::int32_t* hash_values,
                       std::int64_t capacity, const std::int32_t* corner_ids, std::int64_t num_voxels, const T* points,
                       std::int64_t n, T voxel_size, std::int32_t* cell_corner_ids, T* local_coords) {
  const VoxelTable table{hash_keys, hash_values, capacity - 1};
  const T inverse = T(1) / voxel_size;
  for_each(device, n, [=] SPS_HOST_DEVICE(std::int64_t i) {
    const Cell<T> cell =
        find_cell(table, corner_ids, num_voxels,
                  Vec3<T>{points[3 * i] * inverse, points[3 * i + 1] * inverse, points[3 * i + 2] * inverse});
    for (int k = 0; k < kCellCorners; ++k) {
      cell_corner_ids[kCellCorners * i + k] = cell.corner_ids ? cell.corner_ids[k] : kNoVoxel;
    }
    local_coords[3 * i] = cell.local.x;
    local_coords[3 * i + 1] = cell.local.y;
    local_coords[3 * i + 2] = cell.local.z;
  });
}

#define SPS_INSTANTIATE_VOXEL_HASH(Device)                                                                             \
  template void voxel_hash_pack<Device>(Device, const std::int32_t*, std::int64_t, std::int64_t*);                     \
  template void voxel_hash_unpack<Device>(Device, const std::int64_t*, std::int64_t, std::int32_t*);                   \
  template void voxel_hash_find<Device>(Device, const std::int64_t*, const std::int32_t*, std::int64_t,                \
                                        const std::int32_t*, std::int64_t, std::int32_t*);                             \
  template void voxel_hash_update_corner_ids<Device>(Device, const std::int64_t*, const std::int32_t*, std::int64_t,   \
                                                     const std::int32_t*, std::int64_t, std::int64_t, std::int32_t*);  \
  template void voxel_hash_lookup<Device, float>(Device, const std::int64_t*, const std::int32_t*, std::int64_t,       \
                                                 const std::int32_t*, std::int64_t, const float*, std::int64_t, float, \
                                                 std::int32_t*, float*);                                               \
  template void voxel_hash_lookup<Device, double>(Device, const std::int64_t*, const std::int32_t*, std::int64_t,      \
                                                  const std::int32_t*, std::int64_t, const double*, std::int64_t,      \
                                                  double, std::int32_t*, double*);

}  // namespace spslam
