// Each thread makes the motion itself: it is a few operations, and nothing waits for it.
#include "core/for_each.h"
#include "kernels/rolling_shutter.h"

namespace spslam {

template <>
void rectify_shutter_records<Cuda>(Cuda device, const std::int32_t* records, std::int64_t num_records,
                                   const ShutterMotion& motion, const ShutterCamera& camera, std::int32_t* out) {
  for_each(device, num_records, [=] __device__(std::int64_t i) {
    rectify_record(readout_motion(motion), camera, records + kPixelWords * i, out + kPixelWords * i);
  });
}

template <>
void rectify_shutter_images<Cuda>(Cuda device, const FrameImages& images, const ShutterMotion& motion,
                                  const ShutterCamera& camera, std::uint16_t* depth, std::uint8_t* intensity) {
  for_each(device, camera.height * camera.width, [=] __device__(std::int64_t i) {
    const ReadoutMotion readout = readout_motion(motion);
    if (readout.readout == 0.0f) {
      depth[i] = images.depth[i], intensity[i] = images.intensity[i];
      return;
    }
    const ReadPixel from = look_up(images, readout, camera, i / camera.width, i % camera.width);
    rectify_pixel(images, camera, from, depth + i, intensity + i);
  });
}

}  // namespace spslam
