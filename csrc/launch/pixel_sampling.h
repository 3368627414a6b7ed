// Launches of pixel_sampling that are the same for every device.
#pragma once

#include "core/for_each.h"
#include "kernels/pixel_record.h"
#include "spslam/pixel_sampling.h"

namespace spslam {

template <class Device>
void unproject_pixels(Device device, const std::int32_t* records, const float* camera_normals, std::int64_t n,
                      const float* pose, const Intrinsics& intrinsics, float* points, float* normals) {
  const Intrinsics camera = intrinsics;
  for_each(device, n, [=] SPS_HOST_DEVICE(std::int64_t i) {
    const Pose<float> T_world_camera = load_pose(pose);
    const Pixel pixel = unpack_pixel(records + kPixelWords * i);
    const Vec3<float> in_camera = pixel.depth * pixel_ray(pixel, camera);
    const float* n = camera_normals + 3 * i;
    const Vec3<float> point = T_world_camera.rotation * in_camera + T_world_camera.translation;
    const Vec3<float> normal = T_world_camera.rotation * Vec3<float>{n[0], n[1], n[2]};
    points[3 * i] = point.x;
    points[3 * i + 1] = point.y;
    points[3 * i + 2] = point.z;
    normals[3 * i] = normal.x;
    normals[3 * i + 1] = normal.y;
    normals[3 * i + 2] = normal.z;
  });
}

#define SPS_INSTANTIATE_PIXEL_SAMPLING(Device)                                                                  \
  template void unproject_pixels<Device>(Device, const std::int32_t*, const float*, std::int64_t, const float*, \
                                         const Intrinsics&, float*, float*);

}  // namespace spslam
