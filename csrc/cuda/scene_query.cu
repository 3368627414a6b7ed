#include "core/for_each.h"
#include "kernels/scene_element.h"
#include "kernels/voxel_hash.h"
#include "spslam/scene_query.h"

namespace spslam {

template <>
void query_sdf<Cuda>(Cuda device, const SceneView& view, const float* points, std::int64_t n, float* sdf, bool* valid,
                     float* gradient) {
  const SceneView scene = view;
  for_each(device, n, [=] __device__(std::int64_t i) {
    const Vec3<float> point{points[3 * i], points[3 * i + 1], points[3 * i + 2]};
    const Cell<float> cell =
        find_cell(scene.table, scene.corner_ids, scene.num_voxels, (1.0f / scene.voxel_size) * point);
    Vec3<float> slope{0.0f, 0.0f, 0.0f};
    valid[i] = cell.corner_ids != nullptr;
    sdf[i] = valid[i] ? geometry_element(scene, point, cell, gradient ? &slope : nullptr) : 1.0f;
    if (gradient) gradient[3 * i] = slope.x, gradient[3 * i + 1] = slope.y, gradient[3 * i + 2] = slope.z;
  });
}

template <>
void query_color<Cuda>(Cuda device, const SceneView& view, const float* points, std::int64_t n, float* color) {
  const SceneView scene = view;
  for_each(device, n, [=] __device__(std::int64_t i) {
    color_element(scene, {points[3 * i], points[3 * i + 1], points[3 * i + 2]}, color + 3 * i);
  });
}

}  // namespace spslam
