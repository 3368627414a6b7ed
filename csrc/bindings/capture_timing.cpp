#include "spslam/capture_timing.h"

#include "bindings/depth_keyframes.h"

namespace spslam::bindings {
namespace {

void measure_capture_timing(Tensor state, Tensor timing, Tensor pixels, Tensor pose, Tensor noise,
                            std::vector<double> intrinsics, std::vector<Tensor> depth_keyframes,
                            std::vector<double> depth_keyframe_scalars,
                            std::vector<std::int64_t> depth_keyframe_integers) {
  constexpr char kName[] = "measure_capture_timing_";
  SPS_CHECK(state.numel() == kTimingStateSize && timing.numel() == kTimings && state.is_contiguous() &&
                timing.is_contiguous(),
            kName, ": state and timing must be contiguous, of ", kTimingStateSize, " and ", kTimings, " elements");
  SPS_CHECK(pixels.dim() == 2 && pixels.size(1) == 3, kName, ": pixels must have shape [P, 3]");
  SPS_CHECK(pose.numel() == kPoseSize && noise.numel() == kSensorNoiseSize, kName, ": pose must have ", kPoseSize,
            " elements, noise ", kSensorNoiseSize);
  DeviceScope scope(pixels);
  pixels = as_contiguous(pixels);
  pose = as_contiguous(pose);
  noise = as_contiguous(noise);
  depth_keyframes = all_contiguous(depth_keyframes);
  const DepthKeyframes keyframes =
      load_depth_keyframes(kName, depth_keyframes, depth_keyframe_scalars, depth_keyframe_integers);
  SPS_CHECK(keyframes.count == 0 || keyframes.color_delay, kName, ": depth_keyframes must have a timing");
  Tensor workspace =
      empty(pixels, {capture_timing_workspace_size(scope.context, pixels.size(0), keyframes.count)}, ScalarType::Byte);
  spslam::measure_capture_timing(scope.context, data<std::int32_t>(pixels), pixels.size(0), data<float>(pose),
                                 load_intrinsics(kName, intrinsics), data<float>(noise), keyframes,
                                 workspace.mutable_data_ptr(), mutable_data<double>(state),
                                 mutable_data<float>(timing));
}

}  // namespace

#ifndef SPS_CUDA
STABLE_TORCH_LIBRARY_FRAGMENT(spslam, m) {
  m.def(
      "measure_capture_timing_(Tensor(a!) state, Tensor(b!) timing, Tensor pixels, Tensor pose, Tensor noise, float[] "
      "intrinsics, " SPS_DEPTH_KEYFRAMES_SCHEMA ") -> ()");
}
#endif

SPS_LIBRARY_IMPL(m) {
  m.impl("measure_capture_timing_", TORCH_BOX(&measure_capture_timing));
}

}  // namespace spslam::bindings
