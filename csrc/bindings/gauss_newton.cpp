#include "spslam/gauss_newton.h"

#include "bindings/tracking_arguments.h"
#include "spslam/row_copies.h"
#include "spslam/track_frame.h"

namespace spslam::bindings {
namespace {

Tensor predict_pose(Tensor before, Tensor last, double steps) {
  SPS_CHECK(before.numel() == kPoseSize && last.numel() == kPoseSize,
            "predict_pose: before and last must have 7 elements");
  SPS_CHECK(steps > 0.0, "predict_pose: steps must be positive");
  DeviceScope scope(last);
  before = as_contiguous(before);
  last = as_contiguous(last);
  Tensor next = empty(last, {kPoseSize}, ScalarType::Float);
  spslam::predict_pose(scope.context, {data<float>(before), data<float>(last), static_cast<float>(steps)},
                       mutable_data<float>(next));
  return next;
}

// All that tracking finds, in one tensor, which is read at once: the pose that it started from and what it found.
Tensor track_gauss_newton(std::vector<Tensor> scene_tensors, std::vector<double> scene_scalars,
                          std::vector<std::int64_t> plane_layout, std::vector<Tensor> frame,
                          std::vector<double> scalars, std::vector<std::int64_t> integers,
                          std::vector<Tensor> reference, std::vector<double> reference_scalars,
                          std::vector<Tensor> depth_keyframes, std::vector<double> depth_keyframe_scalars,
                          std::vector<std::int64_t> depth_keyframe_integers) {
  constexpr char kName[] = "track_gauss_newton";
  SPS_CHECK(frame.size() == 2 || frame.size() == 3, kName, ": frame must be pixels, a pose and, if known, noise");
  frame = all_contiguous(frame);
  const Tensor &pixels = frame[0], &pose = frame[1];
  SPS_CHECK(pixels.dim() == 2 && pixels.size(1) == 3 && pixels.size(0) > 0, kName,
            ": pixels must have shape [P, 3] with P >= 1");
  SPS_CHECK(pose.numel() == kPoseSize, kName, ": pose must have 7 elements");
  DeviceScope scope(pixels);
  const TrackingArguments arguments(
      kName,
      {scene_tensors, scene_scalars, plane_layout, scalars, integers, reference, reference_scalars, depth_keyframes,
       depth_keyframe_scalars, depth_keyframe_integers},
      frame.size() == 2 ? nullptr : &frame[2]);
  const GaussNewtonOptions& options = arguments.options;
  Tensor found = empty(pose, {kPoseSize + TrackedPose::size(options.iterations)}, ScalarType::Float);
  float* const start = mutable_data<float>(found);
  const TrackedPose result(start + kPoseSize);
  const RowCopy copies[] = {{start, data<float>(pose), kPoseSize * sizeof(float)},
                            {result.pose, data<float>(pose), kPoseSize * sizeof(float)}};
  copy_rows(scope.context, copies, 2);
  Tensor workspace =
      empty(pixels, {gauss_newton_workspace_size(scope.context, 1, options.num_pixels)}, ScalarType::Byte);
  spslam::track_gauss_newton(scope.context, arguments.scene(), data<std::int32_t>(pixels), pixels.size(0), options,
                             workspace.mutable_data_ptr(), result.pose, result.stats, result.hessian);
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
  SPS_CHECK(frames < 1 << 16, "gauss_newton_poses: there must be fewer than 2^16 frames, got ", frames);
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
  m.def("predict_pose(Tensor before, Tensor last, float steps) -> Tensor");
  m.def("track_gauss_newton(" SPS_TRACKING_SCHEMA ") -> Tensor");
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
