// What a tracked frame tells of the sensor: how noisy its images are, and when they are taken.
#include <algorithm>

#include "bindings/depth_keyframes.h"
#include "spslam/capture_timing.h"
#include "spslam/sensor_noise.h"

namespace spslam::bindings {
namespace {

// The frame as arguments of ops; it must outlive the launch.
struct MeasuredFrame {
  Tensor pixels, pose;
  std::vector<Tensor> images;
  Intrinsics camera;
  DepthKeyframes keyframes;
};

MeasuredFrame load_frame(const char* name, const Tensor& pixels, const Tensor& pose,
                         const std::vector<double>& intrinsics, const std::vector<Tensor>& images,
                         const std::vector<double>& scalars, const std::vector<std::int64_t>& integers) {
  SPS_CHECK(has_shape(pixels, {-1, 3}), name, ": pixels must have shape [P, 3]");
  SPS_CHECK(pose.numel() == kPoseSize, name, ": pose must have ", kPoseSize, " elements");
  MeasuredFrame frame{
      as_contiguous(pixels), as_contiguous(pose), readable_keyframes(images), load_intrinsics(name, intrinsics), {}};
  frame.keyframes = load_depth_keyframes(name, frame.images, scalars, integers);
  return frame;
}

void check_noise(const char* name, const Tensor& counts, const Tensor& noise) {
  SPS_CHECK(counts.numel() == kNoiseCounts && noise.numel() == kSensorNoiseSize && counts.is_contiguous() &&
                noise.is_contiguous(),
            name, ": counts and noise must be contiguous, of ", kNoiseCounts, " and ", kSensorNoiseSize, " elements");
}

void check_timing(const char* name, const Tensor& state, const Tensor& timing) {
  SPS_CHECK(state.numel() == kTimingStateSize && timing.numel() == kTimings && state.is_contiguous() &&
                timing.is_contiguous(),
            name, ": state and timing must be contiguous, of ", kTimingStateSize, " and ", kTimings, " elements");
}

// Of the first `most` pixels.
void add_noise(const DeviceScope& scope, const MeasuredFrame& frame, std::int64_t most, Tensor& counts, Tensor& noise) {
  spslam::measure_noise(scope.context, data<std::int32_t>(frame.pixels), std::min(frame.pixels.size(0), most),
                        data<float>(frame.pose), frame.camera, frame.keyframes, mutable_data<std::int32_t>(counts),
                        mutable_data<float>(noise));
}

void add_timing(const DeviceScope& scope, const MeasuredFrame& frame, std::int64_t most, const Tensor& noise,
                Tensor& state, Tensor& timing) {
  const std::int64_t n = std::min(frame.pixels.size(0), most);
  Tensor workspace =
      empty(frame.pixels, {capture_timing_workspace_size(scope.context, n, frame.keyframes.count)}, ScalarType::Byte);
  spslam::measure_capture_timing(scope.context, data<std::int32_t>(frame.pixels), n, data<float>(frame.pose),
                                 frame.camera, data<float>(noise), frame.keyframes, workspace.mutable_data_ptr(),
                                 mutable_data<double>(state), mutable_data<float>(timing));
}

void measure_noise(Tensor counts, Tensor noise, Tensor pixels, Tensor pose, std::vector<double> intrinsics,
                   std::vector<Tensor> depth_keyframes, std::vector<double> depth_keyframe_scalars,
                   std::vector<std::int64_t> depth_keyframe_integers) {
  constexpr char kName[] = "measure_noise_";
  check_noise(kName, counts, noise);
  DeviceScope scope(pixels);
  const MeasuredFrame frame =
      load_frame(kName, pixels, pose, intrinsics, depth_keyframes, depth_keyframe_scalars, depth_keyframe_integers);
  add_noise(scope, frame, frame.pixels.size(0), counts, noise);
}

void measure_capture_timing(Tensor state, Tensor timing, Tensor pixels, Tensor pose, Tensor noise,
                            std::vector<double> intrinsics, std::vector<Tensor> depth_keyframes,
                            std::vector<double> depth_keyframe_scalars,
                            std::vector<std::int64_t> depth_keyframe_integers) {
  constexpr char kName[] = "measure_capture_timing_";
  check_timing(kName, state, timing);
  SPS_CHECK(noise.numel() == kSensorNoiseSize, kName, ": noise must have ", kSensorNoiseSize, " elements");
  DeviceScope scope(pixels);
  const MeasuredFrame frame =
      load_frame(kName, pixels, pose, intrinsics, depth_keyframes, depth_keyframe_scalars, depth_keyframe_integers);
  SPS_CHECK(frame.keyframes.count == 0 || frame.keyframes.color_delay, kName, ": depth_keyframes must have a timing");
  add_timing(scope, frame, frame.pixels.size(0), as_contiguous(noise), state, timing);
}

// Of how many pixels of the frame each is measured at most.
enum class PixelCount { kTiming, kNoise, kCount };

// The times where the keyframes have a timing, then the noise.
void measure_frame(Tensor counts, Tensor noise, Tensor state, Tensor timing, Tensor pixels, Tensor pose,
                   std::vector<double> intrinsics, std::vector<std::int64_t> pixel_counts,
                   std::vector<Tensor> depth_keyframes, std::vector<double> depth_keyframe_scalars,
                   std::vector<std::int64_t> depth_keyframe_integers) {
  constexpr char kName[] = "measure_frame_";
  const Integers<PixelCount> most(kName, "pixel_counts", pixel_counts);
  SPS_CHECK(most[PixelCount::kTiming] >= 0 && most[PixelCount::kNoise] >= 0, kName,
            ": pixel_counts must be at least 0");
  check_noise(kName, counts, noise);
  check_timing(kName, state, timing);
  DeviceScope scope(pixels);
  const MeasuredFrame frame =
      load_frame(kName, pixels, pose, intrinsics, depth_keyframes, depth_keyframe_scalars, depth_keyframe_integers);
  if (frame.keyframes.color_delay) add_timing(scope, frame, most[PixelCount::kTiming], noise, state, timing);
  add_noise(scope, frame, most[PixelCount::kNoise], counts, noise);
}

}  // namespace

#ifndef SPS_CUDA
STABLE_TORCH_LIBRARY_FRAGMENT(spslam, m) {
  m.def(
      "measure_noise_(Tensor(a!) counts, Tensor(b!) noise, Tensor pixels, Tensor pose, float[] "
      "intrinsics, " SPS_DEPTH_KEYFRAMES_SCHEMA ") -> ()");
  m.def(
      "measure_capture_timing_(Tensor(a!) state, Tensor(b!) timing, Tensor pixels, Tensor pose, Tensor noise, float[] "
      "intrinsics, " SPS_DEPTH_KEYFRAMES_SCHEMA ") -> ()");
  m.def(
      "measure_frame_(Tensor(a!) counts, Tensor(b!) noise, Tensor(c!) state, Tensor(d!) timing, Tensor pixels, Tensor "
      "pose, float[] intrinsics, int[] pixel_counts, " SPS_DEPTH_KEYFRAMES_SCHEMA ") -> ()");
}
#endif

SPS_LIBRARY_IMPL(m) {
  m.impl("measure_noise_", TORCH_BOX(&measure_noise));
  m.impl("measure_capture_timing_", TORCH_BOX(&measure_capture_timing));
  m.impl("measure_frame_", TORCH_BOX(&measure_frame));
}

}  // namespace spslam::bindings
