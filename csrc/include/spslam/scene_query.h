// Point queries of the scene: SDF (equation 2) and color (equations 3 and 4).
#pragma once

#include <cstdint>

#include "core/device.h"
#include "spslam/scene_view.h"

namespace spslam {

// sdf[i] = SDF / truncation at points[i] (m), 1 outside the allocated voxels; valid[i] says which are inside.
// gradient [n, 3] = d sdf / d point, 1/m, 0 outside; may be null.
template <class Device>
void query_sdf(Device device, const SceneView& scene, const float* points, std::int64_t n, float* sdf, bool* valid,
               float* gradient);

// color [n, 3] in [0, 1] at points[i] (m).
template <class Device>
void query_color(Device device, const SceneView& scene, const float* points, std::int64_t n, float* color);

}  // namespace spslam
