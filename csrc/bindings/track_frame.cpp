#include "spslam/track_frame.h"

#include "bindings/tracking_arguments.h"

namespace spslam::bindings {
namespace {

// Places in the op's lists of numbers for the motion; spslam/ops/trusted.py fills them.
enum class MotionScalar {
  kFx,
  kFy,
  kCx,
  kCy,
  kHeight,
  kWidth,
  kSeconds,
  kSteps,
  kUnit,
  kBentTurn,
  kFarWay,
  kFarTurn,
  kAgainIterations,
  kCount
};
enum class FrameTensor { kRecords, kDepth, kIntensity, kPoses, kReadout, kNoise, kCount };

// All that tracking finds, in one tensor, which is read at once: the outcome, the pose predicted, the readout, and what
// was found by the first pass and in the end; then the records as the predicted motion rectifies them, and records,
// depth and intensity as the motion found does.
std::tuple<Tensor, Tensor, Tensor, Tensor, Tensor> track_frame(
    std::vector<Tensor> scene_tensors, std::vector<double> scene_scalars, std::vector<std::int64_t> plane_layout,
    std::vector<Tensor> frame, std::vector<double> scalars, std::vector<std::int64_t> integers,
    std::vector<Tensor> reference, std::vector<double> reference_scalars, std::vector<Tensor> depth_keyframes,
    std::vector<double> depth_keyframe_scalars, std::vector<std::int64_t> depth_keyframe_integers,
    std::vector<double> motion_scalars) {
  constexpr char kName[] = "track_frame";
  const Scalars<MotionScalar> moved(kName, "motion_scalars", motion_scalars);
  constexpr std::size_t kTensors = static_cast<std::size_t>(FrameTensor::kCount);
  SPS_CHECK(frame.size() == kTensors || frame.size() + 1 == kTensors, kName,
            ": frame must be records, depth, intensity, poses, readout and, if known, noise");
  frame = all_contiguous(frame);
  const auto tensor = [&](FrameTensor place) -> const Tensor& { return frame[static_cast<std::size_t>(place)]; };
  const Tensor &records = tensor(FrameTensor::kRecords), &depth = tensor(FrameTensor::kDepth),
               &intensity = tensor(FrameTensor::kIntensity), &poses = tensor(FrameTensor::kPoses),
               &readout = tensor(FrameTensor::kReadout);
  const std::int64_t height = moved.as<std::int64_t>(MotionScalar::kHeight),
                     width = moved.as<std::int64_t>(MotionScalar::kWidth);
  SPS_CHECK(has_shape(records, {-1, 3}) && records.size(0) > 0, kName, ": records must have shape [P, 3] with P >= 1");
  SPS_CHECK(height > 1 && width > 1, kName, ": height and width must be above 1");
  SPS_CHECK(depth.dim() == 2 && depth.size(0) > 1 && depth.size(1) > 1 && same_shape(intensity, depth), kName,
            ": depth and intensity must have one shape [H, W], at least two rows and columns");
  SPS_CHECK(has_shape(poses, {2, kPoseSize}), kName, ": poses must have shape [2, ", kPoseSize, "]");
  SPS_CHECK(readout.numel() == 1, kName, ": readout must have one element");
  SPS_CHECK(
      moved[MotionScalar::kSeconds] > 0.0 && moved[MotionScalar::kSteps] > 0.0 && moved[MotionScalar::kUnit] > 0.0,
      kName, ": seconds, steps and unit must be positive");
  DeviceScope scope(records);
  const TrackingArguments arguments(
      kName,
      {scene_tensors, scene_scalars, plane_layout, scalars, integers, reference, reference_scalars, depth_keyframes,
       depth_keyframe_scalars, depth_keyframe_integers},
      frame.size() == kTensors ? &tensor(FrameTensor::kNoise) : nullptr);
  const std::int64_t count = records.size(0), iterations = arguments.options.iterations,
                     again_iterations = moved.as<std::int64_t>(MotionScalar::kAgainIterations);
  check_count(kName, "again_iterations", again_iterations);
  const float unit = moved.as<float>(MotionScalar::kUnit);
  const FrameTracking call{
      arguments.scene(),
      arguments.options,
      again_iterations,
      data<std::int32_t>(records),
      count,
      {data<std::uint16_t>(depth), data<std::uint8_t>(intensity), unit},
      {data<float>(poses), data<float>(poses) + kPoseSize, moved.as<float>(MotionScalar::kSteps)},
      data<float>(readout),
      moved.as<float>(MotionScalar::kSeconds),
      {arguments.options.intrinsics, height, width},
      {load_intrinsics(moved), depth.size(0), depth.size(1)},
      {moved[MotionScalar::kBentTurn], moved[MotionScalar::kFarWay], moved[MotionScalar::kFarTurn]}};
  constexpr std::int64_t kHead = 1 + kPoseSize + 1;  // outcome, predicted pose, readout
  const std::int64_t first = TrackedPose::size(iterations), again = TrackedPose::size(again_iterations);
  Tensor found = empty(poses, {kHead + first + again}, ScalarType::Float);
  Tensor predicted = empty(records, {count, 3}, ScalarType::Int), out = empty(records, {count, 3}, ScalarType::Int);
  Tensor out_depth = empty(depth, {depth.size(0), depth.size(1)}, ScalarType::UInt16);
  Tensor out_intensity = empty(depth, {depth.size(0), depth.size(1)}, ScalarType::Byte);
  Tensor workspace = empty(records, {track_frame_workspace_size(scope.context, call)}, ScalarType::Byte);
  float* const numbers = mutable_data<float>(found);
  spslam::track_frame(scope.context, call, workspace.mutable_data_ptr(),
                      {numbers,
                       numbers + 1,
                       numbers + 1 + kPoseSize,
                       TrackedPose(numbers + kHead),
                       TrackedPose(numbers + kHead + first),
                       mutable_data<std::int32_t>(predicted),
                       {mutable_data<std::int32_t>(out), mutable_data<std::uint16_t>(out_depth),
                        mutable_data<std::uint8_t>(out_intensity)}});
  return {found, predicted, out, out_depth, out_intensity};
}

}  // namespace

#ifndef SPS_CUDA
STABLE_TORCH_LIBRARY_FRAGMENT(spslam, m) {
  m.def("track_frame(" SPS_TRACKING_SCHEMA ", float[] motion_scalars) -> (Tensor, Tensor, Tensor, Tensor, Tensor)");
}
#endif

SPS_LIBRARY_IMPL(m) {
  m.impl("track_frame", TORCH_BOX(&track_frame));
}

}  // namespace spslam::bindings
