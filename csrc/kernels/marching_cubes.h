// Marching cubes of one cell: its own share of the samples, edges, vertices and faces.
//
// Cells that touch share samples, edges and so vertices. Each shared element has one owner among the cells that
// exist, whose value, bit and index are used. So neighbors agree even if their own samples were rounded differently,
// and vertices are shared without a search.
#pragma once

#include <cstdint>

#include "core/macros.h"
#include "kernels/marching_cubes_table.h"
#include "kernels/voxel_hash.h"
#include "spslam/marching_cubes.h"

namespace spslam {

constexpr int kNeighbors = 27;
constexpr int kOwnNeighbor = 13;

// The arrays in the workspace.
struct MarchingCubesWork {
  std::int64_t* hash_keys;
  std::int32_t* hash_values;
  std::int64_t capacity;
  std::int64_t* packed_coords;   // [count]
  std::int64_t* owners;          // [count, 27]: region_owner of each region
  bool* crossed;                 // [count]: both signs occur
  float* samples;                // [count, (n + 1)^3], the owner's values minus the level
  std::uint64_t* edge_bits;      // [count, words]: bit axis * (n + 1)^3 + sample where the edge carries a vertex
  std::int32_t* edge_ranks;      // [count, words]: bits set before the word
  std::int64_t* vertex_offsets;  // [count + 1]: counts first, then their running sum
  std::int64_t* face_offsets;    // [count + 1]
  std::uint64_t* faults;         // kCoord* flags
  std::int64_t words;            // 64-bit words of edge bits per cell
};

SPS_INLINE std::int64_t samples_per_cell(int n) {
  return static_cast<std::int64_t>(n + 1) * (n + 1) * (n + 1);
}

SPS_INLINE void set_bits(std::uint64_t* word, std::uint64_t bits) {
#if defined(__CUDA_ARCH__)
  atomicOr(reinterpret_cast<unsigned long long*>(word), static_cast<unsigned long long>(bits));
#else
  // Most edges are marked by several cubes: a test before the atomic operation saves most of these.
  if ((__atomic_load_n(word, __ATOMIC_RELAXED) & bits) != bits) __atomic_fetch_or(word, bits, __ATOMIC_RELAXED);
#endif
}

SPS_INLINE int count_bits(std::uint64_t bits) {
#if defined(__CUDA_ARCH__)
  return __popcll(bits);
#else
  return __builtin_popcountll(bits);
#endif
}

SPS_INLINE int lowest_bit(std::uint64_t bits) {
#if defined(__CUDA_ARCH__)
  return __ffsll(static_cast<long long>(bits)) - 1;
#else
  return __builtin_ctzll(bits);
#endif
}

// Along each axis a cell's samples lie on its lower side, between, or on its upper side: 27 regions, the last axis
// fastest. Samples of a region belong to the same cells. So do the edges between these samples' axes: an edge counts
// as `between` along its own axis.
constexpr int kBetween = 1;

SPS_INLINE int region_of(int local, int n) {
  return local == 0 ? 0 : local == n ? 2 : kBetween;
}

// The owner of a region among the cells that touch it: the one on the upper side, else the first of the others in a
// fixed order. Packed as cell * 8 + bit a where the region is on the owner's upper side along axis a.
SPS_INLINE std::int64_t region_owner(const std::int32_t* neighbors, int region) {
  const int side[3] = {region / 9, region / 3 % 3, region % 3};
  for (int lower = 0; lower < 8; ++lower) {
    int neighbor = kOwnNeighbor;
    bool touches = true;
    for (int a = 0, stride = 9; a < 3; ++a, stride /= 3) {
      const int bit = (lower >> a) & 1;
      touches = touches && !(side[a] == kBetween && bit);
      neighbor += stride * ((side[a] == 2) - bit);
    }
    if (touches && neighbors[neighbor] >= 0) return static_cast<std::int64_t>(neighbors[neighbor]) * 8 + lower;
  }
  return 0;  // never: the cell itself touches the region
}

SPS_INLINE void find_owners(const VoxelTable& table, const std::int32_t* coords, std::int64_t cell,
                            std::int64_t* owners, std::uint64_t* faults) {
  const VoxelCoord c = load_voxel(coords, cell);
  const bool in_range = voxel_in_range(c);
  if (!in_range) {
    set_bits(faults, kCoordOutOfRange);
  } else if (find_voxel(table, c) != cell) {
    set_bits(faults, kCoordRepeated);
  }
  std::int32_t neighbors[kNeighbors];
  for (int i = 0; i < kNeighbors; ++i) {
    neighbors[i] = in_range ? find_voxel(table, {c.x + i / 9 - 1, c.y + i / 3 % 3 - 1, c.z + i % 3 - 1}) : kNoVoxel;
  }
  neighbors[kOwnNeighbor] = static_cast<std::int32_t>(cell);
  for (int region = 0; region < kNeighbors; ++region) owners[region] = region_owner(neighbors, region);
}

// A sample of a cell: the cell and the sample's place in its array.
struct Sample {
  std::int64_t cell, index;
};

// Sample (i, j, k) of a cell, which lies in `region`, as its owner has it.
SPS_INLINE Sample owners_sample(std::int64_t owner, int n, int region, int i, int j, int k) {
  const int x = region / 9 == kBetween ? i : (owner & 1) ? n : 0;
  const int y = region / 3 % 3 == kBetween ? j : (owner & 2) ? n : 0;
  const int z = region % 3 == kBetween ? k : (owner & 4) ? n : 0;
  return {owner >> 3, (static_cast<std::int64_t>(x) * (n + 1) + y) * (n + 1) + z};
}

// Copies the samples of a region from its owner.
SPS_INLINE void copy_region(const MarchingCubesCells& cells, std::int64_t owner, int region, float* out) {
  const int n = cells.n;
  int begin[3], end[3];
  for (int a = 0, side = region; a < 3; ++a, side = side * 3 % 27) {
    const int s = side / 9;
    begin[a] = s == 0 ? 0 : s == kBetween ? 1 : n;
    end[a] = s == kBetween ? n : begin[a] + 1;
  }
  for (int i = begin[0]; i < end[0]; ++i) {
    for (int j = begin[1]; j < end[1]; ++j) {
      const Sample from = owners_sample(owner, n, region, i, j, begin[2]);
      const float* in = cells.values + from.cell * samples_per_cell(n) + from.index;
      float* row = out + (static_cast<std::int64_t>(i) * (n + 1) + j) * (n + 1) + begin[2];
      for (int k = 0; k < end[2] - begin[2]; ++k) row[k] = in[k] - cells.level;
    }
  }
}

// Copies a cell's samples, each from its owner, and notes whether the surface may cross the cell.
SPS_INLINE void gather_samples(const MarchingCubesCells& cells, const MarchingCubesWork& work, std::int64_t cell) {
  const std::int64_t per_cell = samples_per_cell(cells.n);
  const float* own = cells.values + cell * per_cell;
  float* out = work.samples + cell * per_cell;
  for (std::int64_t s = 0; s < per_cell; ++s) out[s] = own[s] - cells.level;
  for (int region = 0; region < kNeighbors; ++region) {
    const std::int64_t owner = work.owners[cell * kNeighbors + region];
    if (owner >> 3 != cell) copy_region(cells, owner, region, out);
  }
  int inside = 0, outside = 0;
  for (std::int64_t s = 0; s < per_cell; ++s) {
    inside |= out[s] < 0.0f;
    outside |= out[s] >= 0.0f;
  }
  work.crossed[cell] = inside && outside;
}

// Calls f(i, j, k, case) for every cube of the cell that the surface crosses; bit k of the case says that corner k is
// inside. Cubes with an unknown corner are left out.
template <class F>
SPS_INLINE void for_crossed_cubes(const MarchingCubesWork& work, int n, std::int64_t cell, const F& f) {
  if (!work.crossed[cell]) return;
  const int side = n + 1;
  const float* samples = work.samples + cell * samples_per_cell(n);
  for (int i = 0; i < n; ++i) {
    for (int j = 0; j < n; ++j) {
      const float* column = samples + (static_cast<std::int64_t>(i) * side + j) * side;
      int inside = 0;
      bool known = false;
      for (int k = 0; k <= n; ++k) {
        // The four corners at k; x * 0 is 0 unless x is not finite.
        const float a = column[k], b = column[side * side + k], c = column[side + k],
                    d = column[side * side + side + k];
        const int layer = (a < 0.0f) | (b < 0.0f) << 1 | (c < 0.0f) << 2 | (d < 0.0f) << 3;
        const bool layer_known = a * 0.0f + b * 0.0f + c * 0.0f + d * 0.0f == 0.0f;
        inside = inside >> 4 | layer << 4;
        if (k > 0 && known && layer_known && inside != 0 && inside != 255) f(i, j, k - 1, inside);
        known = layer_known;
      }
    }
  }
}

// Edge e of cube (i, j, k) as its owner has it; `index` is the number of its bit.
SPS_INLINE Sample owners_edge(const std::int64_t* owners, int n, int i, int j, int k, int e) {
  const int axis = e >> 2, first = e & 1, second = (e >> 1) & 1;
  const int x = i + (axis == 0 ? 0 : first);
  const int y = j + (axis == 0 ? first : axis == 1 ? 0 : second);
  const int z = k + (axis == 2 ? 0 : second);
  const int region = 9 * (axis == 0 ? kBetween : region_of(x, n)) + 3 * (axis == 1 ? kBetween : region_of(y, n)) +
                     (axis == 2 ? kBetween : region_of(z, n));
  Sample edge = owners_sample(owners[region], n, region, x, y, z);
  edge.index += axis * samples_per_cell(n);
  return edge;
}

// Marks the edges that carry a vertex and counts the cell's faces. Only edges of cubes that are wholly known are
// marked, so that every vertex has a face.
SPS_INLINE void mark_edges(const MarchingCubesCells& cells, const MarchingCubesWork& work, std::int64_t cell) {
  const MarchingCubesTable& table = marching_cubes_table();
  const std::int64_t* owners = work.owners + cell * kNeighbors;
  std::int64_t faces = 0;
  for_crossed_cubes(work, cells.n, cell, [&](int i, int j, int k, int inside) {
    faces += table.triangle_count[inside];
    for (std::uint64_t edges = table.crossed_edges[inside]; edges != 0; edges &= edges - 1) {
      const Sample edge = owners_edge(owners, cells.n, i, j, k, lowest_bit(edges));
      set_bits(work.edge_bits + edge.cell * work.words + edge.index / 64, std::uint64_t{1} << (edge.index % 64));
    }
  });
  work.face_offsets[cell] = faces;
}

SPS_INLINE void rank_edges(const MarchingCubesWork& work, std::int64_t cell) {
  std::int32_t rank = 0;
  for (std::int64_t word = cell * work.words; word < (cell + 1) * work.words; ++word) {
    work.edge_ranks[word] = rank;
    rank += count_bits(work.edge_bits[word]);
  }
  work.vertex_offsets[cell] = rank;
}

SPS_INLINE std::int64_t vertex_index(const MarchingCubesWork& work, const Sample& edge) {
  const std::int64_t word = edge.cell * work.words + edge.index / 64;
  const std::uint64_t before = work.edge_bits[word] & ((std::uint64_t{1} << (edge.index % 64)) - 1);
  return work.vertex_offsets[edge.cell] + work.edge_ranks[word] + count_bits(before);
}

SPS_INLINE void write_vertices(const MarchingCubesCells& cells, const MarchingCubesWork& work, std::int64_t cell,
                               float* vertices) {
  const int side = cells.n + 1;
  const std::int64_t per_cell = samples_per_cell(cells.n);
  const float* samples = work.samples + cell * per_cell;
  float* out = vertices + 3 * work.vertex_offsets[cell];
  for (std::int64_t word = 0; word < work.words; ++word) {
    for (std::uint64_t bits = work.edge_bits[cell * work.words + word]; bits != 0; bits &= bits - 1) {
      const std::int64_t edge = word * 64 + lowest_bit(bits);
      const int axis = static_cast<int>(edge / per_cell);
      const int at = static_cast<int>(edge % per_cell);
      const int local[3] = {at / (side * side), at / side % side, at % side};
      const float low = samples[at], high = samples[at + (axis == 0 ? side * side : axis == 1 ? side : 1)];
      for (int a = 0; a < 3; ++a) {
        const float step = static_cast<float>(local[a]) + (a == axis ? low / (low - high) : 0.0f);
        *out++ = static_cast<float>(cells.coords[3 * cell + a]) + step / static_cast<float>(cells.n);
      }
    }
  }
}

SPS_INLINE void write_faces(const MarchingCubesCells& cells, const MarchingCubesWork& work, std::int64_t cell,
                            std::int64_t* faces) {
  const MarchingCubesTable& table = marching_cubes_table();
  const std::int64_t* owners = work.owners + cell * kNeighbors;
  std::int64_t* out = faces + 3 * work.face_offsets[cell];
  for_crossed_cubes(work, cells.n, cell, [&](int i, int j, int k, int inside) {
    std::int64_t ids[kCubeEdges];
    for (std::uint64_t edges = table.crossed_edges[inside]; edges != 0; edges &= edges - 1) {
      const int e = lowest_bit(edges);
      ids[e] = vertex_index(work, owners_edge(owners, cells.n, i, j, k, e));
    }
    for (int corner = 0; corner < 3 * table.triangle_count[inside]; ++corner) {
      *out++ = ids[table.triangles[inside][corner]];
    }
  });
}

}  // namespace spslam
