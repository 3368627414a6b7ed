// What a tracked frame tells of the sensor: when its images are taken, then how noisy they are, in one call.
#include <algorithm>

#include "bindings/depth_keyframes.h"
#include "spslam/capture_timing.h"
#include "spslam/sensor_noise.h"

namespace spslam::bindings {
namespace {

constexpr char kName[] = "measure_frame_";

// Of how many pixels of the frame each is measured.
enum class PixelCount { kTiming, kNoise, kCount };

void measure_frame(Tensor counts, Tensor noise, Tensor state, Tensor timing, Tensor pixels, Tensor pose,
                   std::vector<double> intrinsics, std::vector<std::int64_t> pixel_counts,
                   std::vector<Tensor> depth_keyframes, std::vector<double> depth_keyframe_scalars,
                   std::vector<std::int64_t> depth_keyframe_integers) {
  const Integers<PixelCount> most(kName, "pixel_counts", pixel_counts);
  SPS_CHECK(counts.numel() == kNoiseCounts && noise.numel() == kSensorNoiseSize && counts.is_contiguous() &&
                noise.is_contiguous() && state.numel() == kTimingStateSize && timing.numel() == kTimings &&
                state.is_contiguous() && timing.is_contiguous(),
            kName, ": counts, noise, state and timing must be contiguous, of ", kNoiseCounts, ", ", kSensorNoiseSize,
            ", ", kTimingStateSize, " and ", kTimings, " elements");
  SPS_CHECK(has_shape(pixels, {-1, 3}), kName, ": pixels must have shape [P, 3]");
  SPS_CHECK(pose.numel() == kPoseSize, kName, ": pose must have ", kPoseSize, " elements");
  SPS_CHECK(most[PixelCount::kTiming] >= 0 && most[PixelCount::kNoise] >= 0, kName,
            ": pixel_counts must be at least 0");
  DeviceScope scope(pixels);
  pixels = as_contiguous(pixels);
  pose = as_contiguous(pose);
  depth_keyframes = all_contiguous(depth_keyframes);
  const DepthKeyframes keyframes =
      load_depth_keyframes(kName, depth_keyframes, depth_keyframe_scalars, depth_keyframe_integers);
  const Intrinsics camera = load_intrinsics(kName, intrinsics);
  const auto count = [&](PixelCount place) { return std::min(pixels.size(0), most[place]); };
  if (keyframes.color_delay) {
    const std::int64_t n = count(PixelCount::kTiming);
    Tensor workspace =
        empty(pixels, {capture_timing_workspace_size(scope.context, n, keyframes.count)}, ScalarType::Byte);
    spslam::measure_capture_timing(scope.context, data<std::int32_t>(pixels), n, data<float>(pose), camera,
                                   data<float>(noise), keyframes, workspace.mutable_data_ptr(),
                                   mutable_data<double>(state), mutable_data<float>(timing));
  }
  spslam::measure_noise(scope.context, data<std::int32_t>(pixels), count(PixelCount::kNoise), data<float>(pose), camera,
                        keyframes, mutable_data<std::int32_t>(counts), mutable_data<float>(noise));
}

}  // namespace

#ifndef SPS_CUDA
STABLE_TORCH_LIBRARY_FRAGMENT(spslam, m) {
  m.def(
      "measure_frame_(Tensor(a!) counts, Tensor(b!) noise, Tensor(c!) state, Tensor(d!) timing, Tensor pixels, Tensor "
      "pose, float[] intrinsics, int[] pixel_counts, " SPS_DEPTH_KEYFRAMES_SCHEMA ") -> ()");
}
#endif

SPS_LIBRARY_IMPL(m) {
  m.impl("measure_frame_", TORCH_BOX(&measure_frame));
}

}  // namespace spslam::bindings
