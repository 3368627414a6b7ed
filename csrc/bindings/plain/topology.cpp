// Plain C functions on triangle meshes, for Python by ctypes. Those that need memory return -1 where there is not
// enough.
#include <new>

#include "bindings/plain/export.h"
#include "spslam/mesh_topology.h"

SPS_EXPORT std::int64_t spslam_vertex_normals(const std::int32_t* faces, std::int64_t num_faces,
                                              std::int64_t num_vertices, const float* points, float* normals) {
  try {
    spslam::vertex_normals(spslam::Cpu{}, {num_vertices, num_faces, faces}, points, normals);
  } catch (const std::bad_alloc&) {
    return -1;
  }
  return 0;
}

SPS_EXPORT std::int64_t spslam_component_areas(const std::int32_t* faces, std::int64_t num_faces,
                                               std::int64_t num_vertices, const float* points, const bool* counted,
                                               double* areas) {
  try {
    spslam::component_areas(spslam::Cpu{}, {num_vertices, num_faces, faces}, points, counted, areas);
  } catch (const std::bad_alloc&) {
    return -1;
  }
  return 0;
}

// Returns how many edges there are.
SPS_EXPORT std::int64_t spslam_mesh_edges(const std::int32_t* faces, std::int64_t num_faces, std::int64_t num_vertices,
                                          std::int64_t* ends, std::int64_t* of_faces) {
  try {
    return spslam::mesh_edges(spslam::Cpu{}, {num_vertices, num_faces, faces}, ends, of_faces);
  } catch (const std::bad_alloc&) {
    return -1;
  }
}

SPS_EXPORT void spslam_edge_middles(std::int64_t count, const std::int64_t* ends, const float* points,
                                    const float* normals, float* middles, float* middle_normals) {
  spslam::edge_middles(spslam::Cpu{}, count, ends, points, normals, middles, middle_normals);
}

SPS_EXPORT void spslam_divide_faces(const std::int32_t* faces, std::int64_t num_faces, std::int64_t num_vertices,
                                    const std::int64_t* middles, const float* points, std::int32_t* parts) {
  spslam::divide_faces(spslam::Cpu{}, {num_vertices, num_faces, faces}, middles, points, parts);
}
