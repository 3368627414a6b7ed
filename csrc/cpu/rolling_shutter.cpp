#include "kernels/rolling_shutter.h"

#include <cstring>

#include "core/for_each.h"
#include "kernels/gauss_newton.h"

namespace spslam {
namespace {

constexpr std::int64_t kRowGrain = 16;
constexpr std::int64_t kLanes = 128;  // pixels that are made together, in vector lanes

// `count` pixels of row y from column `begin` on. By value: nothing that is written can be part of them.
void rectify_lanes(FrameImages images, ReadoutMotion readout, ShutterCamera camera, std::int64_t y, std::int64_t begin,
                   std::int64_t length, std::uint16_t* depth, std::uint8_t* intensity) {
  float own[kLanes], scale[kLanes], by_column[kLanes], by_row[kLanes];
  std::uint16_t read[kLanes];
  std::uint8_t corners[4][kLanes];
  std::int32_t row[kLanes], column[kLanes], top[kLanes], left[kLanes];
  const std::uint16_t* pixels = images.depth + y * camera.width + begin;
  const float v = static_cast<float>(y);
  // Whole numbers of 32 bits, which AVX2 converts in lanes, unlike those of 64.
  const std::int32_t first = static_cast<std::int32_t>(begin), count = static_cast<std::int32_t>(length);
  for (std::int32_t lane = 0; lane < count; ++lane) own[lane] = images.unit * static_cast<float>(pixels[lane]);
  // Not SPS_SIMD: GCC would keep the structs of each lane in memory and vectorize nothing; so it does by itself.
  for (std::int32_t lane = 0; lane < count; ++lane) {
    const ReadPixel from = look_up(own[lane], readout, camera, static_cast<float>(first + lane), v);
    const ReadPlace at = read_place(camera, from);
    scale[lane] = from.scale, by_column[lane] = at.by_column, by_row[lane] = at.by_row;
    row[lane] = at.row, column[lane] = at.column, top[lane] = at.top, left[lane] = at.left;
  }
  for (std::int32_t lane = 0; lane < count; ++lane) {
    read[lane] = images.depth[row[lane] * camera.width + column[lane]];
    const std::uint8_t* corner = images.intensity + top[lane] * camera.width + left[lane];
    corners[0][lane] = corner[0], corners[1][lane] = corner[1];
    corners[2][lane] = corner[camera.width], corners[3][lane] = corner[camera.width + 1];
  }
  SPS_SIMD
  for (std::int32_t lane = 0; lane < count; ++lane) {
    depth[lane] = rectified_depth(scale[lane], static_cast<float>(read[lane]));
    intensity[lane] = rectified_intensity(corners[0][lane], corners[1][lane], corners[2][lane], corners[3][lane],
                                          by_column[lane], by_row[lane]);
  }
}

}  // namespace

template <>
void rectify_shutter_records<Cpu>(Cpu device, const std::int32_t* records, std::int64_t num_records,
                                  const ShutterMotion& motion, const ShutterCamera& camera, std::int32_t* out,
                                  const float* wanted) {
  if (wanted && *wanted != 1.0f) return;
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
    for (std::int64_t y = first; y < last; ++y) {
      for (std::int64_t begin = 0; begin < width; begin += kLanes) {
        const std::int64_t count = width - begin < kLanes ? width - begin : kLanes, at = y * width + begin;
        rectify_lanes(images, readout, camera, y, begin, count, depth + at, intensity + at);
      }
    }
  });
}

template <>
void rectify_shutter_frame<Cpu>(Cpu device, const std::int32_t* records, std::int64_t num_records,
                                const FrameImages& images, const ShutterMotion& motion, const ShutterCamera& camera,
                                const ShutterCamera& image_camera, const ShutterFrame& out) {
  rectify_shutter_records(device, records, num_records, motion, camera, out.records);
  rectify_shutter_images(device, images, motion, image_camera, out.depth, out.intensity);
}

void rectify_shutter_features(Cpu, const float* positions, const float* points, std::int64_t count,
                              const ShutterMotion& motion, const ShutterCamera& camera, float* out_positions,
                              float* out_points) {
  const ReadoutMotion readout = readout_motion(motion);
  if (readout.readout == 0.0f) {
    std::memmove(out_positions, positions, static_cast<std::size_t>(2 * count) * sizeof(float));
    std::memmove(out_points, points, static_cast<std::size_t>(3 * count) * sizeof(float));
    return;
  }
  for (std::int64_t i = 0; i < count; ++i) {
    rectify_feature(readout, camera, positions + 2 * i, points + 3 * i, out_positions + 2 * i, out_points + 3 * i);
  }
}

template <>
void predict_frame<Cpu>(Cpu device, const RecentMotion& motion, const float* readout, float seconds,
                        const std::int32_t* records, std::int64_t num_records, const ShutterCamera& camera,
                        const PredictedFrame& out) {
  constant_speed_pose(motion, out.pose);
  *out.readout = *readout;
  rectify_shutter_records(device, records, num_records, {motion.last, out.pose, readout, seconds}, camera, out.records);
}

}  // namespace spslam
