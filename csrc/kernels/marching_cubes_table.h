// The 256 cases of marching cubes, worked out by the compiler.
//
// Numbering: corner k of a cube is at (k & 1, k >> 1 & 1, k >> 2 & 1). Edge e runs along axis e / 4 from its lower
// corner. Bit k of a case is set where corner k is inside (below the level).
//
// Rule: on each face the surface's trace cuts off every run of inside corners by itself, so where two inside corners
// face each other diagonally they are kept apart. This depends on the four signs of the face alone: the two cubes
// beside it agree, and surfaces are closed across cubes. The traces of the six faces join into loops, and each loop is
// filled by a fan whose diagonals all run through the interior of the cube. Then no edge of the mesh has more than two
// triangles. A fan with such diagonals exists for every loop that occurs.
#pragma once

#include <cstdint>

#include "core/macros.h"

namespace spslam {

constexpr int kCubeEdges = 12;
constexpr int kMaxCubeTriangles = 5;

struct MarchingCubesTable {
  std::uint8_t triangle_count[256];
  std::uint16_t crossed_edges[256];                   // bit e: edge e carries a vertex
  std::int8_t triangles[256][3 * kMaxCubeTriangles];  // edges, counter-clockwise seen from the outside
};

namespace detail {

// The corners of each face, counter-clockwise seen from outside the cube.
constexpr int kFaceCorners[6][4] = {{0, 4, 6, 2}, {1, 3, 7, 5}, {0, 1, 5, 4}, {2, 6, 7, 3}, {0, 2, 3, 1}, {4, 5, 7, 6}};

constexpr int cube_edge(int a, int b) {
  const int lower = a & b;
  const int axis = (a ^ b) >> 1;  // 1, 2, 4 -> 0, 1, 2
  if (axis == 0) return lower >> 1;
  if (axis == 1) return 4 + ((lower & 1) | ((lower >> 1) & 2));
  return 8 + (lower & 3);
}

constexpr bool face_has_edge(int face, int edge) {
  for (int i = 0; i < 4; ++i) {
    if (cube_edge(kFaceCorners[face][i], kFaceCorners[face][(i + 1) % 4]) == edge) return true;
  }
  return false;
}

constexpr bool share_a_face(int edge_a, int edge_b) {
  for (int face = 0; face < 6; ++face) {
    if (face_has_edge(face, edge_a) && face_has_edge(face, edge_b)) return true;
  }
  return false;
}

// next[e] = the edge that the loop through edge e goes to, -1 where e is not crossed.
constexpr void trace_faces(int inside, int* next) {
  for (int e = 0; e < kCubeEdges; ++e) next[e] = -1;
  for (int face = 0; face < 6; ++face) {
    int crossed[4] = {}, count = 0;
    bool enters[4] = {};
    for (int i = 0; i < 4; ++i) {
      const int a = kFaceCorners[face][i], b = kFaceCorners[face][(i + 1) % 4];
      if (((inside >> a) & 1) == ((inside >> b) & 1)) continue;
      enters[count] = (inside >> b) & 1;
      crossed[count++] = cube_edge(a, b);
    }
    for (int i = 0; i < count; ++i) {
      if (enters[i]) next[crossed[i]] = crossed[(i + 1) % count];
    }
  }
}

// First vertex of the loop from which no diagonal of the fan lies in a face.
constexpr int fan_apex(const int* loop, int length) {
  for (int apex = 0; apex < length; ++apex) {
    bool inner = true;
    for (int i = 2; i < length - 1; ++i) inner = inner && !share_a_face(loop[apex], loop[(apex + i) % length]);
    if (inner) return apex;
  }
  return -1;  // never: an index of -1 would stop the compilation
}

constexpr MarchingCubesTable make_marching_cubes_table() {
  MarchingCubesTable table{};
  for (int inside = 0; inside < 256; ++inside) {
    int next[kCubeEdges] = {};
    trace_faces(inside, next);
    int triangles = 0;
    for (int first = 0; first < kCubeEdges; ++first) {
      if (next[first] < 0) continue;
      int loop[kCubeEdges] = {}, length = 0;
      for (int edge = first; next[edge] >= 0;) {
        table.crossed_edges[inside] |= static_cast<std::uint16_t>(1 << edge);
        loop[length++] = edge;
        const int following = next[edge];
        next[edge] = -1;
        edge = following;
      }
      const int apex = fan_apex(loop, length);
      for (int i = 1; i < length - 1; ++i) {
        std::int8_t* corner = table.triangles[inside] + 3 * triangles++;
        corner[0] = static_cast<std::int8_t>(loop[apex]);
        corner[1] = static_cast<std::int8_t>(loop[(apex + i) % length]);
        corner[2] = static_cast<std::int8_t>(loop[(apex + i + 1) % length]);
      }
    }
    table.triangle_count[inside] = static_cast<std::uint8_t>(triangles);
  }
  return table;
}

inline constexpr MarchingCubesTable kHostTable = make_marching_cubes_table();
#if defined(__CUDACC__)
static __device__ constexpr MarchingCubesTable kDeviceTable = make_marching_cubes_table();
#endif

}  // namespace detail

SPS_INLINE const MarchingCubesTable& marching_cubes_table() {
#if defined(__CUDA_ARCH__)
  return detail::kDeviceTable;
#else
  return detail::kHostTable;
#endif
}

}  // namespace spslam
