// Normals, edges, parts and connected components of triangle meshes. On the host alone, by the thread that calls.
#pragma once

#include <cstdint>

#include "core/device.h"

namespace spslam {

// Faces of a mesh of `num_vertices` vertices, fewer than 2^31.
struct Triangles {
  std::int64_t num_vertices, count;
  const std::int32_t* corners;  // [count, 3], each in [0, num_vertices)
};

// Writes unit normals [num_vertices, 3] at `points` float32 [num_vertices, 3]: means over the adjacent faces weighted
// by area; 0 where that is 0.
void vertex_normals(Cpu device, const Triangles& faces, const float* points, float* normals);

// Writes the area of the connected component of each face [count], in the unit of `points` float32 [num_vertices, 3]
// squared. Faces that share a vertex are connected. Where `counted` [count] is not null, other faces connect alone.
void component_areas(Cpu device, const Triangles& faces, const float* points, const bool* counted, double* areas);

// The edges of faces, each once, in ascending order of their ends. Writes those, the lower first, [3 count, 2] at most,
// and which edges each face has [count, 3]: from its first corner to the second, to the third, and back. Returns how
// many there are.
std::int64_t mesh_edges(Cpu device, const Triangles& faces, std::int64_t* ends, std::int64_t* of_faces);

// Writes points and unit normals [count, 3] halfway between vertices `ends` [count, 2]; a normal is 0 where those of
// the ends cancel.
void edge_middles(Cpu device, std::int64_t count, const std::int64_t* ends, const float* points, const float* normals,
                  float* middles, float* middle_normals);

// Divides faces at the middles of their edges: `middles` [count, 3] is the vertex in the middle of each face's edges,
// in the order of `mesh_edges`, -1 for none; `points` float32 are the vertices, those included. A face with one becomes
// two faces, with two three (the quadrilateral is divided along its shorter diagonal), with three four. Writes them
// [count + middles, 3], in the order of those that they are parts of.
void divide_faces(Cpu device, const Triangles& faces, const std::int64_t* middles, const float* points,
                  std::int32_t* parts);

}  // namespace spslam
