// Launches of the signed distance blocks that are the same for every device.
#pragma once

#include "core/for_each.h"
#include "kernels/tsdf.h"
#include "kernels/tsdf_view.h"
#include "spslam/tsdf.h"

namespace spslam {

constexpr std::int64_t kRayGrain = 64;

template <class Device>
void tsdf_query(Device device, const TsdfView& view, const float* points, std::int64_t n, float* sdf, float* colors,
                bool* known) {
  for_each(device, n, [=] SPS_HOST_DEVICE(std::int64_t i) {
    const TsdfSample sample = sample_tsdf(view, {points[3 * i], points[3 * i + 1], points[3 * i + 2]}, true);
    sdf[i] = sample.sdf;
    colors[3 * i] = sample.color.x;
    colors[3 * i + 1] = sample.color.y;
    colors[3 * i + 2] = sample.color.z;
    known[i] = sample.known;
  });
}

template <class Device>
void tsdf_ray_cast(Device device, const TsdfView& view, const RayCastCamera& camera, float* depth, float* normals,
                   float* colors) {
  for_each(
      device, static_cast<std::int64_t>(camera.width) * camera.height,
      [=] SPS_HOST_DEVICE(std::int64_t i) {
        const Pose<float> pose = load_pose(camera.pose);
        const Vec3<float> ray{(static_cast<float>(i % camera.width) - camera.camera.cx) / camera.camera.fx,
                              (static_cast<float>(i / camera.width) - camera.camera.cy) / camera.camera.fy, 1.0f};
        const RayHit hit = cast_ray(view, pose.translation, pose.rotation * ray, camera.near, camera.far);
        const bool found = hit.depth > 0.0f;
        const Vec3<float> none{0.0f, 0.0f, 0.0f};
        const Vec3<float> normal = found ? tsdf_normal(view, hit.world) : none;
        const Vec3<float> color = found ? sample_tsdf(view, hit.world, true).color : none;
        depth[i] = hit.depth;
        normals[3 * i] = normal.x;
        normals[3 * i + 1] = normal.y;
        normals[3 * i + 2] = normal.z;
        colors[3 * i] = color.x;
        colors[3 * i + 1] = color.y;
        colors[3 * i + 2] = color.z;
      },
      kRayGrain);
}

#define SPS_INSTANTIATE_TSDF(Device)                                                                            \
  template void tsdf_query<Device>(Device, const TsdfView&, const float*, std::int64_t, float*, float*, bool*); \
  template void tsdf_ray_cast<Device>(Device, const TsdfView&, const RayCastCamera&, float*, float*, float*);

}  // namespace spslam
