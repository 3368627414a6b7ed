#include "launch/voxel_hash.h"

#include <algorithm>

#include "cpu/key_sort.h"

namespace spslam {
namespace {

// Stops at `enough`: a table that is half empty is not read much farther than an insertion is long.
std::int64_t count_empty_slots(const std::int64_t* hash_keys, std::int64_t capacity, std::int64_t enough) {
  std::int64_t empty = 0;
  for (std::int64_t slot = 0; slot < capacity && empty < enough; ++slot) empty += hash_keys[slot] == kEmptyVoxelKey;
  return empty;
}

}  // namespace

template <>
std::int64_t voxel_hash_workspace_bytes<Cpu>(Cpu, std::int64_t) {
  return 0;
}

template <>
AbsentVoxels voxel_hash_absent<Cpu>(Cpu device, const std::int64_t* hash_keys, const std::int32_t* hash_values,
                                    std::int64_t capacity, const std::int32_t* voxel_coords, std::int64_t n, void*,
                                    std::int64_t* absent_keys) {
  constexpr std::int64_t kOutOfRange = -2;
  const VoxelTable table{hash_keys, hash_values, capacity - 1};
  for_each(device, n, [=](std::int64_t i) {
    const VoxelCoord c = load_voxel(voxel_coords, i);
    if (!voxel_in_range(c)) {
      absent_keys[i] = kOutOfRange;
      return;
    }
    const std::int64_t key = pack_voxel(c);
    absent_keys[i] = find_voxel_key(table, key) == kNoVoxel ? key : kEmptyVoxelKey;
  });
  const std::int64_t out_of_range = std::count(absent_keys, absent_keys + n, kOutOfRange);
  std::int64_t* end = std::remove_if(absent_keys, absent_keys + n, [](std::int64_t key) { return key < 0; });
  if (!std::is_sorted(absent_keys, end)) sort_keys(absent_keys, end - absent_keys);
  end = std::unique(absent_keys, end);
  const std::int64_t count = end - absent_keys;
  return {count, out_of_range, count_empty_slots(hash_keys, capacity, count)};
}

// In one thread: slots depend on the order of insertion, and a table's bytes should not depend on the thread count.
template <>
void voxel_hash_assign<Cpu>(Cpu, std::int64_t* hash_keys, std::int32_t* hash_values, std::int64_t capacity,
                            const std::int64_t* keys, std::int64_t n, std::int32_t first_id) {
  const std::int64_t mask = capacity - 1;
  for (std::int64_t i = 0; i < n; ++i) {
    std::int64_t slot = voxel_slot(keys[i], mask), probes = 1;
    for (; hash_keys[slot] != kEmptyVoxelKey && probes < capacity; ++probes) slot = (slot + 1) & mask;
    if (hash_keys[slot] != kEmptyVoxelKey) continue;
    hash_keys[slot] = keys[i];
    hash_values[slot] = first_id + static_cast<std::int32_t>(i);
  }
}

SPS_INSTANTIATE_VOXEL_HASH(Cpu)

}  // namespace spslam
