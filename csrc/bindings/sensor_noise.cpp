#include "spslam/sensor_noise.h"

#include "bindings/depth_keyframes.h"

namespace spslam::bindings {
namespace {

void measure_noise(Tensor counts, Tensor noise, Tensor pixels, Tensor pose, std::vector<double> intrinsics,
                   std::vector<Tensor> depth_keyframes, std::vector<double> depth_keyframe_scalars,
                   std::vector<std::int64_t> depth_keyframe_integers) {
  constexpr char kName[] = "measure_noise_";
  SPS_CHECK(counts.numel() == kNoiseCounts && noise.numel() == kSensorNoiseSize && counts.is_contiguous() &&
                noise.is_contiguous(),
            kName, ": counts and noise must be contiguous, of ", kNoiseCounts, " and ", kSensorNoiseSize, " elements");
  SPS_CHECK(pixels.dim() == 2 && pixels.size(1) == 3, kName, ": pixels must have shape [P, 3]");
  SPS_CHECK(pose.numel() == kPoseSize, kName, ": pose must have 7 elements");
  DeviceScope scope(pixels);
  pixels = as_contiguous(pixels);
  pose = as_contiguous(pose);
  depth_keyframes = all_contiguous(depth_keyframes);
  const DepthKeyframes keyframes =
      load_depth_keyframes(kName, depth_keyframes, depth_keyframe_scalars, depth_keyframe_integers);
  spslam::measure_noise(scope.context, data<std::int32_t>(pixels), pixels.size(0), data<float>(pose),
                        load_intrinsics(kName, intrinsics), keyframes, mutable_data<std::int32_t>(counts),
                        mutable_data<float>(noise));
}

}  // namespace

#ifndef SPS_CUDA
STABLE_TORCH_LIBRARY_FRAGMENT(spslam, m) {
  m.def(
      "measure_noise_(Tensor(a!) counts, Tensor(b!) noise, Tensor pixels, Tensor pose, float[] "
      "intrinsics, " SPS_DEPTH_KEYFRAMES_SCHEMA ") -> ()");
}
#endif

SPS_LIBRARY_IMPL(m) {
  m.impl("measure_noise_", TORCH_BOX(&measure_noise));
}

}  // namespace spslam::bindings
