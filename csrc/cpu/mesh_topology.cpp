#include "spslam/mesh_topology.h"

#include <algorithm>
#include <cmath>
#include <numeric>
#include <vector>

#include "core/vec.h"

namespace spslam {
namespace {

Vec3<float> row(const float* values, std::int64_t index) {
  return {values[3 * index], values[3 * index + 1], values[3 * index + 2]};
}

void write(const Vec3<float>& value, float* values, std::int64_t index) {
  values[3 * index] = value.x, values[3 * index + 1] = value.y, values[3 * index + 2] = value.z;
}

// Normal of a face whose corners are counter-clockwise, twice as long as its area.
Vec3<double> face_normal(const Triangles& faces, const float* points, std::int64_t face) {
  Vec3<double> at[3];
  for (int k = 0; k < 3; ++k) {
    const float* point = points + 3 * static_cast<std::int64_t>(faces.corners[3 * face + k]);
    at[k] = {point[0], point[1], point[2]};
  }
  return cross(at[1] - at[0], at[2] - at[0]);
}

// The lowest vertex connected with one, as far as is known; halves the way there for the next time.
std::int32_t root_of(std::int32_t* parents, std::int32_t vertex) {
  while (parents[vertex] != vertex) {
    parents[vertex] = parents[parents[vertex]];
    vertex = parents[vertex];
  }
  return vertex;
}

// An edge of one face: its higher end, and its place among all [count, 3].
struct FaceEdge {
  std::int32_t high;
  std::int64_t place;
};

// The faces' edges in order of their lower ends; those of vertex v are from `begins[v]` to `begins[v + 1]`.
struct FaceEdges {
  std::vector<std::int64_t> begins;
  std::vector<FaceEdge> edges;
};

FaceEdges by_lower_end(const Triangles& faces) {
  FaceEdges sorted{std::vector<std::int64_t>(faces.num_vertices + 2), std::vector<FaceEdge>(3 * faces.count)};
  // Counted two rows further down, so that filling a row in moves its beginning to where it belongs.
  const auto for_each_edge = [&](auto&& use) {
    for (std::int64_t face = 0; face < faces.count; ++face) {
      const std::int32_t* corner = faces.corners + 3 * face;
      for (int k = 0; k < 3; ++k) {
        const std::int32_t one = corner[k], other = corner[(k + 1) % 3];
        use(std::min(one, other), FaceEdge{std::max(one, other), 3 * face + k});
      }
    }
  };
  for_each_edge([&](std::int32_t low, const FaceEdge&) { ++sorted.begins[low + 2]; });
  std::partial_sum(sorted.begins.begin(), sorted.begins.end(), sorted.begins.begin());
  for_each_edge([&](std::int32_t low, const FaceEdge& edge) { sorted.edges[sorted.begins[low + 1]++] = edge; });
  return sorted;
}

// Writes triangles one after the other.
struct Parts {
  std::int32_t* at;

  void add(std::int64_t a, std::int64_t b, std::int64_t c) {
    at[0] = static_cast<std::int32_t>(a), at[1] = static_cast<std::int32_t>(b), at[2] = static_cast<std::int32_t>(c);
    at += 3;
  }
};

}  // namespace

void vertex_normals(Cpu, const Triangles& faces, const float* points, float* normals) {
  std::vector<Vec3<double>> sums(faces.num_vertices, Vec3<double>{0, 0, 0});
  for (std::int64_t face = 0; face < faces.count; ++face) {
    const std::int32_t* corner = faces.corners + 3 * face;
    const Vec3<double> normal = face_normal(faces, points, face);
    for (int k = 0; k < 3; ++k) sums[corner[k]] = sums[corner[k]] + normal;
  }
  for (std::int64_t vertex = 0; vertex < faces.num_vertices; ++vertex) {
    const Vec3<double>& sum = sums[vertex];
    const double length = std::sqrt(dot(sum, sum)), scale = length > 0 ? 1 / length : 0;
    write({static_cast<float>(scale * sum.x), static_cast<float>(scale * sum.y), static_cast<float>(scale * sum.z)},
          normals, vertex);
  }
}

void component_areas(Cpu, const Triangles& faces, const float* points, const bool* counted, double* areas) {
  std::vector<std::int32_t> parents(faces.num_vertices);
  std::iota(parents.begin(), parents.end(), 0);
  for (std::int64_t face = 0; face < faces.count; ++face) {
    const std::int32_t* corner = faces.corners + 3 * face;
    std::int32_t root = root_of(parents.data(), corner[0]);
    for (int k = 1; k < 3; ++k) {
      const std::int32_t other = root_of(parents.data(), corner[k]);
      parents[std::max(root, other)] = std::min(root, other);
      root = std::min(root, other);
    }
  }
  std::vector<double> sums(faces.num_vertices);
  for (std::int64_t face = 0; face < faces.count; ++face) {
    if (counted && !counted[face]) continue;
    const Vec3<double> normal = face_normal(faces, points, face);
    sums[root_of(parents.data(), faces.corners[3 * face])] += 0.5 * std::sqrt(dot(normal, normal));
  }
  for (std::int64_t face = 0; face < faces.count; ++face) {
    areas[face] = sums[root_of(parents.data(), faces.corners[3 * face])];
  }
}

std::int64_t mesh_edges(Cpu, const Triangles& faces, std::int64_t* ends, std::int64_t* of_faces) {
  FaceEdges sorted = by_lower_end(faces);
  std::int64_t count = 0;
  for (std::int64_t low = 0; low < faces.num_vertices; ++low) {
    const auto begin = sorted.edges.begin() + sorted.begins[low], end = sorted.edges.begin() + sorted.begins[low + 1];
    std::sort(begin, end, [](const FaceEdge& one, const FaceEdge& other) { return one.high < other.high; });
    for (auto edge = begin; edge != end; ++edge) {
      if (edge == begin || edge->high != (edge - 1)->high) {
        ends[2 * count] = low, ends[2 * count + 1] = edge->high;
        ++count;
      }
      of_faces[edge->place] = count - 1;
    }
  }
  return count;
}

void edge_middles(Cpu, std::int64_t count, const std::int64_t* ends, const float* points, const float* normals,
                  float* middles, float* middle_normals) {
  for (std::int64_t edge = 0; edge < count; ++edge) {
    const std::int64_t one = ends[2 * edge], other = ends[2 * edge + 1];
    write(0.5f * (row(points, one) + row(points, other)), middles, edge);
    const Vec3<float> sum = row(normals, one) + row(normals, other);
    const float length = std::sqrt(dot(sum, sum));
    write(length > 0 ? Vec3<float>{sum.x / length, sum.y / length, sum.z / length} : Vec3<float>{0, 0, 0},
          middle_normals, edge);
  }
}

void divide_faces(Cpu, const Triangles& faces, const std::int64_t* middles, const float* points, std::int32_t* parts) {
  Parts out{parts};
  for (std::int64_t face = 0; face < faces.count; ++face) {
    const std::int32_t* corner = faces.corners + 3 * face;
    const std::int64_t* middle = middles + 3 * face;
    const int number = (middle[0] >= 0) + (middle[1] >= 0) + (middle[2] >= 0);
    // Turned so that the only middle is on the first edge, and of two the third edge has none.
    const int turn = number == 1   ? (middle[0] >= 0   ? 0
                                      : middle[1] >= 0 ? 1
                                                       : 2)
                     : number == 2 ? (middle[0] < 0   ? 1
                                      : middle[1] < 0 ? 2
                                                      : 0)
                                   : 0;
    const std::int64_t a = corner[turn], b = corner[(turn + 1) % 3], c = corner[(turn + 2) % 3];
    const std::int64_t ab = middle[turn], bc = middle[(turn + 1) % 3], ca = middle[(turn + 2) % 3];
    if (number == 0) {
      out.add(a, b, c);
    } else if (number == 1) {
      out.add(a, ab, c), out.add(ab, b, c);
    } else if (number == 2) {
      const Vec3<float> from_a = row(points, bc) - row(points, a), from_c = row(points, ab) - row(points, c);
      const bool at_a = dot(from_a, from_a) <= dot(from_c, from_c);
      out.add(ab, b, bc), out.add(a, ab, at_a ? bc : c), out.add(at_a ? a : ab, bc, c);
    } else {
      out.add(a, ab, ca), out.add(ab, b, bc), out.add(ca, bc, c), out.add(ab, bc, ca);
    }
  }
}

}  // namespace spslam
