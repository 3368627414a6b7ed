#include "kernels/rolling_shutter.h"

#include <cstring>

#include "core/for_each.h"

namespace spslam {
namespace {

constexpr std::int64_t kRowGrain = 16;
constexpr std::int64_t kLanes = 128;  // pixels that are looked up together, in vector lanes

}  // namespace

template <>
void rectify_shutter_records<Cpu>(Cpu device, const std::int32_t* records, std::int64_t num_records,
                                  const ShutterMotion& motion, const ShutterCamera& camera, std::int32_t* out) {
  const ReadoutMotion readout = readout_motion(motion);
  for_each(device, num_records,
           [&](std::int64_t i) { rectify_record(readout, camera, records + kPixelWords * i, out + kPixelWords * i); });
}

template <>
void rectify_shutter_images<Cpu>(Cpu, const FrameImages& images, const ShutterMotion& motion,
                                 const ShutterCamera& camera, std::uint16_t* depth, std::uint8_t* intensity) {
  const ReadoutMotion readout = readout_motion(motion);
  const std::int64_t width = camera.width;
  if (readout.readout == 0.0f) {
    const std::size_t pixels = static_cast<std::size_t>(camera.height * width);
    std::memcpy(depth, images.depth, pixels * sizeof(std::uint16_t));
    std::memcpy(intensity, images.intensity, pixels);
    return;
  }
  parallel_for(camera.height, kRowGrain, [&](std::int64_t first, std::int64_t last) {
    float column[kLanes], row[kLanes], scale[kLanes];
    for (std::int64_t y = first; y < last; ++y) {
      for (std::int64_t begin = 0; begin < width; begin += kLanes) {
        const std::int64_t count = width - begin < kLanes ? width - begin : kLanes;
        SPS_SIMD
        for (std::int64_t lane = 0; lane < count; ++lane) {
          const ReadPixel from = look_up(images, readout, camera, y, begin + lane);
          column[lane] = from.column, row[lane] = from.row, scale[lane] = from.scale;
        }
        for (std::int64_t lane = 0; lane < count; ++lane) {
          const std::int64_t at = y * width + begin + lane;
          rectify_pixel(images, camera, {column[lane], row[lane], scale[lane]}, depth + at, intensity + at);
        }
      }
    }
  });
}

}  // namespace spslam
