// Each thread makes the motion itself: it is a few operations, and nothing waits for it.
#include "core/for_each.h"
#include "kernels/gauss_newton.h"
#include "kernels/rolling_shutter.h"

namespace spslam {
namespace {

__device__ __forceinline__ void rectify_image_pixel(const FrameImages& images, const ReadoutMotion& readout,
                                                    const ShutterCamera& camera, std::int64_t i, std::uint16_t* depth,
                                                    std::uint8_t* intensity) {
  if (readout.readout == 0.0f) {
    depth[i] = images.depth[i], intensity[i] = images.intensity[i];
    return;
  }
  const float own = images.unit * static_cast<float>(images.depth[i]);
  const float u = static_cast<float>(i % camera.width), v = static_cast<float>(i / camera.width);
  const ReadPixel from = look_up(own, readout, camera, u, v);
  rectify_pixel(images, camera, from, depth + i, intensity + i);
}

}  // namespace

template <>
void rectify_shutter_records<Cuda>(Cuda device, const std::int32_t* records, std::int64_t num_records,
                                   const ShutterMotion& motion, const ShutterCamera& camera, std::int32_t* out,
                                   const float* wanted) {
  for_each(device, num_records, [=] __device__(std::int64_t i) {
    if (wanted && *wanted != 1.0f) return;
    rectify_record(readout_motion(motion), camera, records + kPixelWords * i, out + kPixelWords * i);
  });
}

template <>
void rectify_shutter_images<Cuda>(Cuda device, const FrameImages& images, const ShutterMotion& motion,
                                  const ShutterCamera& camera, std::uint16_t* depth, std::uint8_t* intensity) {
  for_each(device, camera.height * camera.width, [=] __device__(std::int64_t i) {
    rectify_image_pixel(images, readout_motion(motion), camera, i, depth, intensity);
  });
}

template <>
void rectify_shutter_frame<Cuda>(Cuda device, const std::int32_t* records, std::int64_t num_records,
                                 const FrameImages& images, const ShutterMotion& motion, const ShutterCamera& camera,
                                 const ShutterCamera& image_camera, const ShutterFrame& out) {
  for_each(device, num_records + image_camera.height * image_camera.width, [=] __device__(std::int64_t i) {
    const ReadoutMotion readout = readout_motion(motion);
    if (i < num_records) {
      rectify_record(readout, camera, records + kPixelWords * i, out.records + kPixelWords * i);
    } else {
      rectify_image_pixel(images, readout, image_camera, i - num_records, out.depth, out.intensity);
    }
  });
}

template <>
void predict_frame<Cuda>(Cuda device, const RecentMotion& recent, const float* readout, float seconds,
                         const std::int32_t* records, std::int64_t num_records, const ShutterCamera& camera,
                         const PredictedFrame& out) {
  const RecentMotion motion = recent;
  for_each(device, num_records > 0 ? num_records : 1, [=] __device__(std::int64_t i) {
    float pose[kPoseSize];
    constant_speed_pose(motion, pose);
    if (i == 0) {
      for (int c = 0; c < kPoseSize; ++c) out.pose[c] = pose[c];
      *out.readout = *readout;
    }
    if (i >= num_records) return;
    rectify_record(readout_motion({motion.last, pose, readout, seconds}), camera, records + kPixelWords * i,
                   out.records + kPixelWords * i);
  });
}

}  // namespace spslam
