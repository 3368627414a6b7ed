// The passes of marching cubes, the same for every device.
#pragma once

#include <type_traits>

#include "core/for_each.h"
#include "kernels/marching_cubes.h"
#include "launch/workspace.h"
#include "spslam/marching_cubes.h"
#include "spslam/voxel_hash.h"

namespace spslam {

// Cells per chunk: each is n^3 cubes of work.
constexpr std::int64_t kCellGrain = 32;

// Lays the arrays out in the workspace; `bytes` is their size.
inline MarchingCubesWork marching_cubes_layout(std::int64_t count, int n, void* workspace, std::int64_t* bytes) {
  MarchingCubesWork work{};
  work.capacity = 2;
  while (work.capacity < 2 * count) work.capacity *= 2;
  work.words = (3 * samples_per_cell(n) + 63) / 64;
  Workspace memory(workspace);
  const auto take = [&](auto*& array, std::int64_t length) {
    array = memory.take<std::remove_pointer_t<std::decay_t<decltype(array)>>>(length);
  };
  take(work.faults, 1);
  take(work.hash_keys, work.capacity);
  take(work.hash_values, work.capacity);
  take(work.packed_coords, count);
  take(work.owners, count * kNeighbors);
  take(work.crossed, count);
  take(work.samples, count * samples_per_cell(n));
  take(work.edge_bits, count * work.words);
  take(work.edge_ranks, count * work.words);
  take(work.vertex_offsets, count + 1);
  take(work.face_offsets, count + 1);
  *bytes = memory.used();
  return work;
}

inline MarchingCubesWork marching_cubes_layout(const MarchingCubesCells& cells, void* workspace) {
  std::int64_t bytes = 0;
  return marching_cubes_layout(cells.count, cells.n, workspace, &bytes);
}

template <class Device>
std::int64_t marching_cubes_workspace_bytes(Device, std::int64_t count, int n) {
  std::int64_t bytes = 0;
  marching_cubes_layout(count, n, nullptr, &bytes);
  return bytes;
}

template <class Device>
void clear_work(Device device, const MarchingCubesWork& work, std::int64_t count) {
  for_each(device, work.capacity, [=] SPS_HOST_DEVICE(std::int64_t i) { work.hash_keys[i] = kEmptyVoxelKey; });
  for_each(device, count * work.words, [=] SPS_HOST_DEVICE(std::int64_t i) { work.edge_bits[i] = 0; });
  for_each(device, 1, [=] SPS_HOST_DEVICE(std::int64_t) { *work.faults = 0; });
}

// Everything up to the counts per cell; the device's own file sums them.
template <class Device>
void marching_cubes_mark(Device device, const MarchingCubesCells& cells, const MarchingCubesWork& work) {
  clear_work(device, work, cells.count);
  voxel_hash_pack(device, cells.coords, cells.count, work.packed_coords);
  voxel_hash_assign(device, work.hash_keys, work.hash_values, work.capacity, work.packed_coords, cells.count, 0);
  const VoxelTable table{work.hash_keys, work.hash_values, work.capacity - 1};
  for_each(
      device, cells.count,
      [=] SPS_HOST_DEVICE(std::int64_t cell) {
        find_owners(table, cells.coords, cell, work.owners + cell * kNeighbors, work.faults);
      },
      kCellGrain);
  for_each(
      device, cells.count, [=] SPS_HOST_DEVICE(std::int64_t cell) { gather_samples(cells, work, cell); }, kCellGrain);
  for_each(device, cells.count, [=] SPS_HOST_DEVICE(std::int64_t cell) { mark_edges(cells, work, cell); }, kCellGrain);
  for_each(device, cells.count, [=] SPS_HOST_DEVICE(std::int64_t cell) { rank_edges(work, cell); });
}

template <class Device>
void marching_cubes_fill(Device device, const MarchingCubesCells& cells, void* workspace, float* vertices,
                         std::int64_t* faces) {
  const MarchingCubesWork work = marching_cubes_layout(cells, workspace);
  for_each(
      device, cells.count, [=] SPS_HOST_DEVICE(std::int64_t cell) { write_vertices(cells, work, cell, vertices); },
      kCellGrain);
  for_each(
      device, cells.count, [=] SPS_HOST_DEVICE(std::int64_t cell) { write_faces(cells, work, cell, faces); },
      kCellGrain);
}

#define SPS_INSTANTIATE_MARCHING_CUBES(Device)                                             \
  template std::int64_t marching_cubes_workspace_bytes<Device>(Device, std::int64_t, int); \
  template void marching_cubes_fill<Device>(Device, const MarchingCubesCells&, void*, float*, std::int64_t*);

}  // namespace spslam
