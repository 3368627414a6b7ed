#include "spslam/gauss_newton.h"

#include "bindings/depth_keyframes.h"
#include "bindings/scene.h"
#include "spslam/row_copies.h"

namespace spslam::bindings {
namespace {

Tensor predict_pose(Tensor before, Tensor last) {
  SPS_CHECK(before.numel() == kPoseSize && last.numel() == kPoseSize,
            "predict_pose: before and last must have 7 elements");
  DeviceScope scope(last);
  before = as_contiguous(before);
  last = as_contiguous(last);
  Tensor next = empty(last, {kPoseSize}, ScalarType::Float);
  spslam::predict_pose(scope.context, data<float>(before), data<float>(last), mutable_data<float>(next));
  return next;
}

constexpr char kName[] = "track_gauss_newton";

// Places in the op's lists of numbers; spslam/ops/gauss_newton.py fills them.
#define SPS_NAME_PLACE(type, name) name,
enum class Scalar { kFx, kFy, kCx, kCy, SPS_GAUSS_NEWTON_SCALARS(SPS_NAME_PLACE) kCount };
#undef SPS_NAME_PLACE
enum class Integer { kNumPixels, kIterations, kSeed, kStream, kFrame, kTf32, kCount };
enum class ReferenceScalar { kFx, kFy, kCx, kCy, kWeight, kKernel, kMotionRow, kMotionSeconds, kColorOffset, kCount };

// Of the cells, the pose and, if known, the log gain; none without tensors. They must outlive the launch.
ReferenceImage load_reference(const std::vector<Tensor>& tensors, const std::vector<double>& numbers,
                              std::int64_t poses) {
  if (tensors.empty()) return {};
  const Scalars<ReferenceScalar> scalars(kName, "reference_scalars", numbers);
  SPS_CHECK((tensors.size() == 2 || (tensors.size() == 3 && tensors[2].numel() == 1)) && tensors[0].dim() == 3 &&
                tensors[0].size(2) == 2 && tensors[1].numel() == kPoseSize,
            kName, ": reference must be cells [H, W, 2], a pose [7] and, if any, a log gain [1]");
  const double row = scalars[ReferenceScalar::kMotionRow], seconds = scalars[ReferenceScalar::kMotionSeconds];
  SPS_CHECK(row < 0.0 || poses == 0 || (row < static_cast<double>(poses) && seconds > 0.0), kName,
            ": reference must name a pose that is there and a positive time, got ", row, " and ", seconds, " s");
  return {data<float>(tensors[0]),
          data<float>(tensors[1]),
          tensors[0].size(0),
          tensors[0].size(1),
          load_intrinsics(scalars),
          scalars.as<float>(ReferenceScalar::kWeight),
          scalars.as<float>(ReferenceScalar::kKernel),
          {row < 0.0 ? -1 : static_cast<std::int64_t>(row), static_cast<float>(seconds),
           scalars.as<float>(ReferenceScalar::kColorOffset)},
          tensors.size() == 3 ? data<float>(tensors[2]) : nullptr};
}

GaussNewtonOptions load_options(const Scalars<Scalar>& scalars, const Integers<Integer>& integers) {
  GaussNewtonOptions options{};
  options.intrinsics = load_intrinsics(scalars);
  options.num_pixels = integers[Integer::kNumPixels];
  options.iterations = integers[Integer::kIterations];
#define SPS_LOAD_FIELD(type, name) options.name = scalars.as<type>(Scalar::name);
  SPS_GAUSS_NEWTON_SCALARS(SPS_LOAD_FIELD)
#undef SPS_LOAD_FIELD
  options.key = load_key(integers, 0);
  options.tf32 = integers.as<bool>(Integer::kTf32);
  check_count(kName, "num_pixels", options.num_pixels);
  check_count(kName, "iterations", options.iterations);
  return options;
}

// All that tracking finds, in one tensor, which is read at once: the pose that it started from and the one it found, H
// and the statistics of every iteration.
Tensor track_gauss_newton(std::vector<Tensor> scene_tensors, std::vector<double> scene_scalars,
                          std::vector<std::int64_t> plane_layout, std::vector<Tensor> frame,
                          std::vector<double> scalars, std::vector<std::int64_t> integers,
                          std::vector<Tensor> reference, std::vector<double> reference_scalars,
                          std::vector<Tensor> depth_keyframes, std::vector<double> depth_keyframe_scalars,
                          std::vector<std::int64_t> depth_keyframe_integers) {
  SPS_CHECK(frame.size() == 2 || frame.size() == 3, kName, ": frame must be pixels, a pose and, if known, noise");
  frame = all_contiguous(frame);
  const Tensor &pixels = frame[0], &pose = frame[1];
  SPS_CHECK(pixels.dim() == 2 && pixels.size(1) == 3 && pixels.size(0) > 0, kName,
            ": pixels must have shape [P, 3] with P >= 1");
  SPS_CHECK(pose.numel() == kPoseSize, kName, ": pose must have 7 elements");
  DeviceScope scope(pixels);
  const SceneArgument scene(scene_tensors, scene_scalars, plane_layout);
  reference = all_contiguous(reference);
  depth_keyframes = readable_keyframes(depth_keyframes);
  GaussNewtonOptions options = load_options({kName, "scalars", scalars}, {kName, "integers", integers});
  SPS_CHECK(frame.size() == 2 || frame[2].numel() == kSensorNoiseSize, kName, ": noise must have ", kSensorNoiseSize,
            " elements");
  options.noise = frame.size() == 2 ? nullptr : data<float>(frame[2]);
  options.reference =
      load_reference(reference, reference_scalars, depth_keyframes.empty() ? 0 : depth_keyframes[1].size(0));
  options.depth_keyframes =
      load_depth_keyframes(kName, depth_keyframes, depth_keyframe_scalars, depth_keyframe_integers);
  Tensor found = empty(pose, {2 * kPoseSize + 36 + options.iterations * kFrameStatSize}, ScalarType::Float);
  float* const start = mutable_data<float>(found);
  float* const result = start + kPoseSize;
  float* const hessian = result + kPoseSize;
  float* const stats = hessian + 36;
  const RowCopy copies[] = {{start, data<float>(pose), kPoseSize * sizeof(float)},
                            {result, data<float>(pose), kPoseSize * sizeof(float)}};
  copy_rows(scope.context, copies, 2);
  Tensor workspace =
      empty(pixels, {gauss_newton_workspace_size(scope.context, 1, options.num_pixels)}, ScalarType::Byte);
  spslam::track_gauss_newton(scope.context, scene.view, data<std::int32_t>(pixels), pixels.size(0), options,
                             workspace.mutable_data_ptr(), result, stats, hessian);
  return found;
}

std::tuple<Tensor, Tensor, Tensor, Tensor> gauss_newton_poses(std::vector<Tensor> tensors, std::vector<double> scalars,
                                                              std::vector<std::int64_t> layout, Tensor pixels,
                                                              Tensor poses, std::vector<double> intrinsics,
                                                              double truncation, double kernel) {
  SPS_CHECK(pixels.dim() == 3 && pixels.size(2) == 3, "gauss_newton_poses: pixels must have shape [F, N, 3]");
  SPS_CHECK(poses.dim() == 2 && poses.size(0) == pixels.size(0) && poses.size(1) == kPoseSize,
            "gauss_newton_poses: poses must have shape [F, 7]");
  DeviceScope scope(pixels);
  const SceneArgument scene(tensors, scalars, layout);
  pixels = as_contiguous(pixels);
  poses = as_contiguous(poses);
  const std::int64_t frames = pixels.size(0), count = pixels.size(1);
  check_count("gauss_newton_poses", "pixels of a frame", count, 0);
  Tensor hessian = empty(poses, {frames, 6, 6}, ScalarType::Float);
  Tensor gradient = empty(poses, {frames, 6}, ScalarType::Float);
  Tensor cost = empty(poses, {frames}, ScalarType::Float);
  Tensor inliers = empty(poses, {frames}, ScalarType::Float);
  Tensor workspace = empty(pixels, {gauss_newton_workspace_size(scope.context, frames, count)}, ScalarType::Byte);
  spslam::gauss_newton_poses(scope.context, scene.view, data<std::int32_t>(pixels), data<float>(poses), frames, count,
                             load_intrinsics("gauss_newton_poses", intrinsics), static_cast<float>(truncation),
                             static_cast<float>(kernel), workspace.mutable_data_ptr(),
                             {mutable_data<float>(hessian), mutable_data<float>(gradient), mutable_data<float>(cost),
                              mutable_data<float>(inliers)});
  return {hessian, gradient, cost, inliers};
}

}  // namespace

#ifndef SPS_CUDA
STABLE_TORCH_LIBRARY_FRAGMENT(spslam, m) {
  m.def("predict_pose(Tensor before, Tensor last) -> Tensor");
  m.def("track_gauss_newton(" SPS_SCENE_SCHEMA
        ", Tensor[] frame, float[] scalars, int[] integers, Tensor[] reference, "
        "float[] reference_scalars, " SPS_DEPTH_KEYFRAMES_SCHEMA ") -> Tensor");
  m.def("gauss_newton_poses(" SPS_SCENE_SCHEMA
        ", Tensor pixels, Tensor poses, float[] intrinsics, float truncation, float kernel) "
        "-> (Tensor, Tensor, Tensor, Tensor)");
}
#endif

SPS_LIBRARY_IMPL(m) {
  m.impl("predict_pose", TORCH_BOX(&predict_pose));
  m.impl("track_gauss_newton", TORCH_BOX(&track_gauss_newton));
  m.impl("gauss_newton_poses", TORCH_BOX(&gauss_newton_poses));
}

}  // namespace spslam::bindings
