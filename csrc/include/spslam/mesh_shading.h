// Colors of the pixels of a rasterized mesh. On the host alone, by the thread that calls.
#pragma once

#include <cstdint>

#include "core/device.h"
#include "spslam/rasterization.h"

namespace spslam {

// What `rasterize` found, [height, width] each.
struct RasterView {
  const float* depth;
  const std::int32_t* face_ids;
};

// Writes, of the face that each pixel sees, the unit normal towards the camera and the color between those of its
// corners, float32 [height, width, 3] each; 0 for background. `colors` is [V, 3].
void rastered_surface(Cpu device, const CameraMesh& mesh, const std::uint8_t* colors, const PinholeView& view,
                      const RasterView& raster, float* normals, float* pixel_colors);

// A light from a direction (unit length, from the surface), and one from everywhere.
struct MeshLight {
  float direction[3], ambient, diffuse;
};

// Writes the lighted colors [count, 3], `background` where there is no face. Normals need no unit length.
void light_pixels(Cpu device, const MeshLight& light, std::int64_t count, const std::int32_t* face_ids,
                  const float* normals, const float* pixel_colors, std::uint8_t background, std::uint8_t* image);

}  // namespace spslam
