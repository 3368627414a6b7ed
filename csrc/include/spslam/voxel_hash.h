// The voxel hash table: voxel coordinates to ids, and the row of corner ids beside each voxel vertex.
//
// A table is two arrays of `capacity` slots, a power of two, at most half of them used: keys (packed coordinates, -1 is
// empty) and values (ids). Which slot a key sits in may differ from run to run on CUDA; ids never do.
#pragma once

#include <cstdint>

#include "core/device.h"

namespace spslam {

// Scratch bytes that voxel_hash_absent needs for n coordinates.
template <class Device>
std::int64_t voxel_hash_workspace_bytes(Device device, std::int64_t n);

struct AbsentVoxels {
  std::int64_t count;         // distinct coordinates that the table lacks
  std::int64_t out_of_range;  // input rows outside 21 bits per axis
  std::int64_t empty_slots;   // of the table, counted up to `count` at least
};

// Writes the packed coordinates that the table lacks, sorted and unique, into absent_keys [n]; returns how many.
// Waits for the device.
template <class Device>
AbsentVoxels voxel_hash_absent(Device device, const std::int64_t* hash_keys, const std::int32_t* hash_values,
                               std::int64_t capacity, const std::int32_t* voxel_coords, std::int64_t n, void* workspace,
                               std::int64_t* absent_keys);

// Enters n keys that are distinct and absent, with ids first_id, first_id + 1, ... There must be an empty slot for
// each: a key that finds none is left out.
template <class Device>
void voxel_hash_assign(Device device, std::int64_t* hash_keys, std::int32_t* hash_values, std::int64_t capacity,
                       const std::int64_t* keys, std::int64_t n, std::int32_t first_id);

template <class Device>
void voxel_hash_pack(Device device, const std::int32_t* voxel_coords, std::int64_t n, std::int64_t* keys);

template <class Device>
void voxel_hash_unpack(Device device, const std::int64_t* keys, std::int64_t n, std::int32_t* voxel_coords);

// voxel_ids[i] = id of row i, -1 where absent or out of range.
template <class Device>
void voxel_hash_find(Device device, const std::int64_t* hash_keys, const std::int32_t* hash_values,
                     std::int64_t capacity, const std::int32_t* voxel_coords, std::int64_t n, std::int32_t* voxel_ids);

// Fills corner_ids rows [first_new, num_voxels) and those older rows that a new vertex completes.
template <class Device>
void voxel_hash_update_corner_ids(Device device, const std::int64_t* hash_keys, const std::int32_t* hash_values,
                                  std::int64_t capacity, const std::int32_t* voxel_coords, std::int64_t num_voxels,
                                  std::int64_t first_new, std::int32_t* corner_ids);

// The cell around each point: its corner ids (-1 outside the allocated cells, and of vertices beyond the num_voxels
// rows of corner_ids) and local coordinates in [0, 1].
template <class Device, class T>
void voxel_hash_lookup(Device device, const std::int64_t* hash_keys, const std::int32_t* hash_values,
                       std::int64_t capacity, const std::int32_t* corner_ids, std::int64_t num_voxels, const T* points,
                       std::int64_t n, T voxel_size, std::int32_t* cell_corner_ids, T* local_coords);

}  // namespace spslam
