// The rays of one iteration of a whole call, drawn and packed as render_step takes them.
#pragma once

#include "core/for_each.h"
#include "kernels/pose_adam.h"
#include "kernels/ray_source.h"
#include "launch/render_step_buffers.h"

namespace spslam {

// A call's random keys in an iteration.
inline RaySource at_iteration(RaySource source, std::int64_t iteration) {
  source.draw.iteration += static_cast<std::uint32_t>(iteration);
  return source;
}
inline RenderOptions at_iteration(RenderOptions options, std::int64_t iteration) {
  options.key.iteration += static_cast<std::uint32_t>(iteration);
  return options;
}

// All members are public: nvcc takes no device lambda from a private function.
struct DrawnRays {
  std::int32_t *pixels, *slots;  // [R, 3], [R]
  float* poses;                  // [slots, 7]

  DrawnRays(Workspace& memory, const RaySource& source)
      : pixels(memory.take<std::int32_t>(kPixelWords * source.num_rays)),
        slots(memory.take<std::int32_t>(source.num_rays)),
        poses(memory.take<float>(kPoseSize * source.num_slots)) {}

  RayBatch batch(const RaySource& source, const Intrinsics& intrinsics) const {
    return {pixels, slots, source.num_rays, poses, source.num_slots, intrinsics};
  }

  template <class Device>
  void draw(Device device, const RaySource& from) const {
    const RaySource source = from;
    const DrawnRays out = *this;
    for_each(device, source.num_rays, [=] SPS_HOST_DEVICE(std::int64_t r) {
      const std::int64_t slot = ray_slot(source, r);
      const std::int32_t* record = ray_record(source, r, slot_row(source, slot));
      for (int k = 0; k < kPixelWords; ++k) out.pixels[kPixelWords * r + k] = record[k];
      out.slots[r] = static_cast<std::int32_t>(slot);
    });
    for_each(device, source.num_slots, [=] SPS_HOST_DEVICE(std::int64_t slot) {
      const float* pose = source.poses + kPoseSize * slot_row(source, slot);
      for (int k = 0; k < kPoseSize; ++k) out.poses[kPoseSize * slot + k] = pose[k];
    });
  }
};

}  // namespace spslam
