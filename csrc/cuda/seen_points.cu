// One thread per pixel or point.
#include "launch/seen_points.h"

namespace spslam {
template <>
void see_points<Cuda>(Cuda device, const SeenSurface& surface, const SeenFrame& frame, std::uint8_t* colors,
                      float* weights, void* workspace) {
  const std::int64_t stride = drawn_stride(frame), pixels = stride * (std::int64_t{frame.height} + 2);
  float *drawn = static_cast<float*>(workspace), *lowest = drawn + pixels;
  for_each(device, pixels, [=] __device__(std::int64_t i) {
    drawn[i] = kNothingDrawn;
    lowest[i] = 0.0f;
  });
  for_each(device, surface.count, [=] __device__(std::int64_t i) {
    const Pose<float> pose = load_pose(frame.pose);
    if (!sphere_in_view(frame, pose, surface.spheres + 4 * (i / kSeenRun))) return;
    const float* p = surface.points + 3 * i;
    const SeenPlace at = seen_place(frame, pose, {p[0], p[1], p[2]});
    const std::int32_t pixel = nearest_pixel(frame, at.u, at.v, at.z, static_cast<std::int32_t>(stride));
    if (pixel < 0) return;
    float* to = drawn + stride + 1 + pixel;
    // Of positive numbers the bits are in the same order.
    atomicMin(reinterpret_cast<int*>(to), __float_as_int(at.z));
  });
  for_each(device, std::int64_t{frame.width} * frame.height, [=] __device__(std::int64_t i) {
    const std::int64_t place = (i / frame.width + 1) * stride + i % frame.width + 1;
    lowest[place] = least_around(drawn + place, stride);
  });
  for_each(device, surface.count, [=] __device__(std::int64_t i) {
    float weight = 0.0f;
    std::uint8_t color[3] = {0, 0, 0};
    const Pose<float> pose = load_pose(frame.pose);
    if (sphere_in_view(frame, pose, surface.spheres + 4 * (i / kSeenRun))) {
      const float *p = surface.points + 3 * i, *n = surface.normals + 3 * i;
      const Vec3<float> world{p[0], p[1], p[2]};
      const SeenPlace at = seen_place(frame, pose, world);
      const std::int32_t pixel = nearest_pixel(frame, at.u, at.v, at.z, frame.width);
      if (pixel >= 0) {
        const std::int64_t place = (pixel / frame.width + 1) * stride + pixel % frame.width + 1;
        const float front = smaller(drawn[place], most_around(lowest + place, stride));
        const float measured = frame.depth[pixel];
        weight = seen_weight(frame, at.z, seen_cosine(pose, world, {n[0], n[1], n[2]}), front, measured);
        if (weight > 0.0f) seen_color(frame, at.u, at.v, color);
      }
    }
    weights[i] = weight;
    for (int c = 0; c < 3; ++c) colors[3 * i + c] = color[c];
  });
}

SPS_INSTANTIATE_SEEN_POINTS(Cuda)

}  // namespace spslam
