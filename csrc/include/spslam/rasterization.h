// Which face of a mesh is nearest at each pixel. On the host alone, by the thread that calls.
#pragma once

#include <cstdint>

#include "core/device.h"

namespace spslam {

// A pinhole camera's image, px; integers are pixel centers.
struct PinholeView {
  std::int32_t width, height;
  double fx, fy, cx, cy;
};

// Triangles in a camera's axes, m.
struct CameraMesh {
  std::int64_t num_faces;
  const double* points;       // [V, 3]
  const std::int32_t* faces;  // [num_faces, 3], each in [0, V)
};

// Writes the depth float32 [height, width] along the optical axis (m; 0 for background) and the face [height, width]
// (-1 there) of what each pixel's center sees, by a z-buffer. Faces are clipped `nearest` m before the camera; of those
// at the same depth the one with the highest index is visible; those that are not finite are not. With `cull_back`
// faces are seen from one side, from where their corners are counter-clockwise.
void rasterize(Cpu device, const CameraMesh& mesh, const PinholeView& view, double nearest, bool cull_back,
               float* depth, std::int32_t* face_ids);

}  // namespace spslam
