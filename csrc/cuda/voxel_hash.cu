#include <cub/device/device_radix_sort.cuh>
#include <cub/device/device_select.cuh>

#include "core/cuda_check.cuh"
#include "launch/voxel_hash.h"

namespace spslam {
namespace {

// Sorted last, as an unsigned number; no packed coordinate reaches it.
constexpr std::uint64_t kNotAbsent = ~std::uint64_t{0};

struct Counters {
  std::int64_t unique;
  unsigned long long out_of_range, empty_slots;
  std::uint64_t last;
};

std::size_t aligned(std::size_t bytes) {
  return (bytes + 255) & ~std::size_t{255};
}

// The regions of the workspace, in order: two key arrays, counters, CUB's own scratch.
struct Workspace {
  Workspace(void* base, std::int64_t n) {
    const std::size_t key_bytes = aligned(n * sizeof(std::uint64_t));
    char* start = static_cast<char*>(base);
    keys = reinterpret_cast<std::uint64_t*>(start);
    sorted = reinterpret_cast<std::uint64_t*>(start + key_bytes);
    counters = reinterpret_cast<Counters*>(start + 2 * key_bytes);
    scratch = start + 2 * key_bytes + aligned(sizeof(Counters));
    std::size_t sort_bytes = 0, unique_bytes = 0;
    SPS_CUDA_CHECK(cub::DeviceRadixSort::SortKeys(nullptr, sort_bytes, keys, sorted, n));
    SPS_CUDA_CHECK(cub::DeviceSelect::Unique(nullptr, unique_bytes, sorted, keys, &counters->unique, n));
    scratch_bytes = sort_bytes > unique_bytes ? sort_bytes : unique_bytes;
    total_bytes = 2 * key_bytes + aligned(sizeof(Counters)) + scratch_bytes;
  }
  std::uint64_t *keys, *sorted;
  Counters* counters;
  char* scratch;
  std::size_t scratch_bytes, total_bytes;
};

// Adds the empty slots of a table to `count`, one addition for every kSlotsPerThread slots.
void count_empty_slots(Cuda device, const std::int64_t* hash_keys, std::int64_t capacity, unsigned long long* count) {
  constexpr std::int64_t kSlotsPerThread = 64;
  const std::int64_t threads = (capacity + kSlotsPerThread - 1) / kSlotsPerThread;
  for_each(device, threads, [=] __device__(std::int64_t i) {
    unsigned long long empty = 0;
    for (std::int64_t slot = i; slot < capacity; slot += threads) empty += hash_keys[slot] == kEmptyVoxelKey;
    atomicAdd(count, empty);
  });
}

}  // namespace

template <>
std::int64_t voxel_hash_workspace_bytes<Cuda>(Cuda, std::int64_t n) {
  return static_cast<std::int64_t>(Workspace(nullptr, n).total_bytes);
}

template <>
AbsentVoxels voxel_hash_absent<Cuda>(Cuda device, const std::int64_t* hash_keys, const std::int32_t* hash_values,
                                     std::int64_t capacity, const std::int32_t* voxel_coords, std::int64_t n,
                                     void* workspace, std::int64_t* absent_keys) {
  if (n == 0) return {0, 0, 0};
  const cudaStream_t stream = static_cast<cudaStream_t>(device.stream);
  const Workspace space(workspace, n);
  SPS_CUDA_CHECK(cudaMemsetAsync(space.counters, 0, sizeof(Counters), stream));
  const VoxelTable table{hash_keys, hash_values, capacity - 1};
  std::uint64_t* keys = space.keys;
  Counters* counters = space.counters;
  for_each(device, n, [=] __device__(std::int64_t i) {
    const VoxelCoord c = load_voxel(voxel_coords, i);
    const bool in_range = voxel_in_range(c);
    if (!in_range) atomicAdd(&counters->out_of_range, 1ull);
    keys[i] = in_range && find_voxel(table, c) == kNoVoxel ? static_cast<std::uint64_t>(pack_voxel(c)) : kNotAbsent;
  });
  std::size_t bytes = space.scratch_bytes;
  SPS_CUDA_CHECK(cub::DeviceRadixSort::SortKeys(space.scratch, bytes, keys, space.sorted, n, 0, 64, stream));
  bytes = space.scratch_bytes;
  SPS_CUDA_CHECK(cub::DeviceSelect::Unique(
      space.scratch, bytes, space.sorted, reinterpret_cast<std::uint64_t*>(absent_keys), &counters->unique, n, stream));
  count_empty_slots(device, hash_keys, capacity, &counters->empty_slots);
  const std::uint64_t* sorted = space.sorted;
  for_each(device, 1, [=] __device__(std::int64_t) { counters->last = sorted[n - 1]; });
  Counters host;
  SPS_CUDA_CHECK(cudaMemcpyAsync(&host, counters, sizeof(host), cudaMemcpyDeviceToHost, stream));
  SPS_CUDA_CHECK(cudaStreamSynchronize(stream));
  return {host.unique - (host.last == kNotAbsent), static_cast<std::int64_t>(host.out_of_range),
          static_cast<std::int64_t>(host.empty_slots)};
}

template <>
void voxel_hash_assign<Cuda>(Cuda device, std::int64_t* hash_keys, std::int32_t* hash_values, std::int64_t capacity,
                             const std::int64_t* keys, std::int64_t n, std::int32_t first_id) {
  const std::int64_t mask = capacity - 1;
  constexpr unsigned long long kEmpty = static_cast<unsigned long long>(kEmptyVoxelKey);
  for_each(device, n, [=] __device__(std::int64_t i) {
    const unsigned long long key = static_cast<unsigned long long>(keys[i]);
    std::int64_t slot = voxel_slot(keys[i], mask);
    for (std::int64_t probes = 0; probes < capacity; ++probes, slot = (slot + 1) & mask) {
      if (atomicCAS(reinterpret_cast<unsigned long long*>(hash_keys) + slot, kEmpty, key) != kEmpty) continue;
      hash_values[slot] = first_id + static_cast<std::int32_t>(i);
      return;
    }
  });
}

SPS_INSTANTIATE_VOXEL_HASH(Cuda)

}  // namespace spslam
