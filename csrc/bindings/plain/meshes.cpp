// Plain C functions that picture meshes, for Python by ctypes: reports are written without torch.
#include "bindings/plain/export.h"
#include "spslam/mesh_shading.h"
#include "spslam/rasterization.h"

namespace {

// size: width and height. numbers: focal lengths and principal point, px.
spslam::PinholeView view_of(const std::int32_t* size, const double* numbers) {
  return {size[0], size[1], numbers[0], numbers[1], numbers[2], numbers[3]};
}

}  // namespace

// size, numbers: as of `view_of`, and behind these numbers the nearest depth, m.
SPS_EXPORT void spslam_rasterize(const double* points, const std::int32_t* faces, std::int64_t num_faces,
                                 const std::int32_t* size, const double* numbers, int cull_back, float* depth,
                                 std::int32_t* face_ids) {
  spslam::rasterize(spslam::Cpu{}, {num_faces, points, faces}, view_of(size, numbers), numbers[4], cull_back != 0,
                    depth, face_ids);
}

SPS_EXPORT void spslam_rastered_surface(const double* points, const std::int32_t* faces, std::int64_t num_faces,
                                        const std::uint8_t* colors, const std::int32_t* size, const double* numbers,
                                        const float* depth, const std::int32_t* face_ids, float* normals,
                                        float* pixel_colors) {
  spslam::rastered_surface(spslam::Cpu{}, {num_faces, points, faces}, colors, view_of(size, numbers), {depth, face_ids},
                           normals, pixel_colors);
}

// numbers: those of a `MeshLight` in its order.
SPS_EXPORT void spslam_light_pixels(const float* numbers, std::int64_t count, const std::int32_t* face_ids,
                                    const float* normals, const float* pixel_colors, int background,
                                    std::uint8_t* image) {
  const spslam::MeshLight light{{numbers[0], numbers[1], numbers[2]}, numbers[3], numbers[4]};
  spslam::light_pixels(spslam::Cpu{}, light, count, face_ids, normals, pixel_colors,
                       static_cast<std::uint8_t>(background), image);
}
