#include "spslam/gauss_newton.h"

#include "bindings/scene.h"

namespace spslam::bindings {
namespace {

Tensor predict_pose(Tensor before, Tensor last) {
  SPS_CHECK(before.numel() == kPoseSize && last.numel() == kPoseSize,
            "predict_pose: before and last must have 7 elements");
  DeviceScope scope(last);
  before = torch::stable::contiguous(before);
  last = torch::stable::contiguous(last);
  Tensor next = empty(last, {kPoseSize}, ScalarType::Float);
  spslam::predict_pose(scope.context, data<float>(before), data<float>(last), mutable_data<float>(next));
  return next;
}

// None without cells. The tensors must outlive the launch.
ReferenceImage load_reference(const std::optional<Tensor>& cells, const std::optional<Tensor>& pose,
                              const std::vector<double>& intrinsics, double weight, double kernel) {
  if (!cells || !pose) return {};
  SPS_CHECK(cells->dim() == 3 && cells->size(2) == 2 && pose->numel() == kPoseSize,
            "track_gauss_newton: reference must have shape [H, W, 2], its pose [7]");
  return {data<float>(*cells),
          data<float>(*pose),
          cells->size(0),
          cells->size(1),
          load_intrinsics(intrinsics),
          static_cast<float>(weight),
          static_cast<float>(kernel)};
}

// None without images. Row 2 k of `rows` is view k's image, row 2 k + 1 its pose.
DepthKeyframes load_depth_keyframes(const std::optional<Tensor>& images, const std::optional<Tensor>& poses,
                      const std::vector<std::int64_t>& rows, const std::vector<double>& intrinsics, double unit,
                      double kernel_end, std::int64_t first_iteration) {
  if (!images || !poses || rows.empty()) return {};
  SPS_CHECK(images->dim() == 3 && poses->dim() == 2 && poses->size(1) == kPoseSize && unit > 0.0 && kernel_end > 0.0,
            "track_gauss_newton: views must have shape [R, H, W], their poses [F, 7]");
  SPS_CHECK(rows.size() % 2 == 0 && rows.size() <= 2 * kMaxDepthKeyframes, "track_gauss_newton: at most 8 views");
  DepthKeyframes views{data<std::uint16_t>(*images),
                   data<float>(*poses),
                   images->size(1),
                   images->size(2),
                   load_intrinsics(intrinsics),
                   static_cast<float>(unit),
                   static_cast<float>(kernel_end),
                   first_iteration,
                   static_cast<int>(rows.size() / 2),
                   {},
                   {}};
  for (int k = 0; k < views.count; ++k) {
    views.image_rows[k] = rows[2 * k];
    views.pose_rows[k] = rows[2 * k + 1];
    SPS_CHECK(views.image_rows[k] >= 0 && views.image_rows[k] < images->size(0) && views.pose_rows[k] >= 0 &&
                  views.pose_rows[k] < poses->size(0),
              "track_gauss_newton: a view names an image or a pose that is not there");
  }
  return views;
}

std::tuple<Tensor, Tensor, Tensor> track_gauss_newton(
    std::vector<Tensor> tensors, std::vector<double> scalars, std::vector<std::int64_t> layout, Tensor pixels,
    Tensor pose, std::vector<double> intrinsics, std::int64_t num_pixels, std::int64_t iterations, double truncation,
    double kernel_start, double kernel_end, double score_kernel, double damping, std::int64_t seed, std::int64_t stream,
    std::int64_t frame, double noise_crossover_depth, std::optional<Tensor> reference, std::optional<Tensor> reference_pose,
    std::vector<double> reference_intrinsics, double intensity_weight, double intensity_kernel,
    std::optional<Tensor> views, std::optional<Tensor> view_poses, std::vector<std::int64_t> view_rows,
    std::vector<double> view_intrinsics, double depth_image_unit, double view_kernel_end, std::int64_t view_first_iteration,
    bool tf32) {
  SPS_CHECK(pixels.dim() == 2 && pixels.size(1) == 3 && pixels.size(0) > 0,
            "track_gauss_newton: pixels must have shape [P, 3] with P >= 1");
  SPS_CHECK(pose.numel() == kPoseSize, "track_gauss_newton: pose must have 7 elements");
  check_count("track_gauss_newton", "num_pixels", num_pixels);
  check_count("track_gauss_newton", "iterations", iterations);
  DeviceScope scope(pixels);
  const SceneArgument scene(tensors, scalars, layout);
  pixels = torch::stable::contiguous(pixels);
  if (reference) reference = torch::stable::contiguous(*reference);
  if (reference_pose) reference_pose = torch::stable::contiguous(*reference_pose);
  if (views) views = torch::stable::contiguous(*views);
  if (view_poses) view_poses = torch::stable::contiguous(*view_poses);
  Tensor result = torch::stable::clone(torch::stable::contiguous(pose));
  Tensor stats = empty(pose, {iterations, kTrackingStatSize}, ScalarType::Float);
  Tensor hessian = empty(pose, {6, 6}, ScalarType::Float);
  Tensor workspace = empty(pixels, {gauss_newton_workspace_size(scope.context, 1, num_pixels)}, ScalarType::Byte);
  const TrackingOptions options{
      load_intrinsics(intrinsics),
      num_pixels,
      iterations,
      static_cast<float>(truncation),
      static_cast<float>(kernel_start),
      static_cast<float>(kernel_end),
      static_cast<float>(score_kernel),
      damping,
      philox_key(seed, stream, frame, 0),
      static_cast<float>(noise_crossover_depth),
      load_reference(reference, reference_pose, reference_intrinsics, intensity_weight, intensity_kernel),
      load_depth_keyframes(views, view_poses, view_rows, view_intrinsics, depth_image_unit, view_kernel_end, view_first_iteration),
      tf32};
  spslam::track_gauss_newton(scope.context, scene.view, data<std::int32_t>(pixels), pixels.size(0), options,
                             workspace.mutable_data_ptr(), mutable_data<float>(result), mutable_data<float>(stats),
                             mutable_data<float>(hessian));
  return {result, stats, hessian};
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
  pixels = torch::stable::contiguous(pixels);
  poses = torch::stable::contiguous(poses);
  const std::int64_t frames = pixels.size(0), count = pixels.size(1);
  check_count("gauss_newton_poses", "pixels of a frame", count, 0);
  Tensor hessian = empty(poses, {frames, 6, 6}, ScalarType::Float);
  Tensor gradient = empty(poses, {frames, 6}, ScalarType::Float);
  Tensor cost = empty(poses, {frames}, ScalarType::Float);
  Tensor inliers = empty(poses, {frames}, ScalarType::Float);
  Tensor workspace = empty(pixels, {gauss_newton_workspace_size(scope.context, frames, count)}, ScalarType::Byte);
  spslam::gauss_newton_poses(scope.context, scene.view, data<std::int32_t>(pixels), data<float>(poses), frames, count,
                             load_intrinsics(intrinsics), static_cast<float>(truncation), static_cast<float>(kernel),
                             workspace.mutable_data_ptr(), mutable_data<float>(hessian), mutable_data<float>(gradient),
                             mutable_data<float>(cost), mutable_data<float>(inliers));
  return {hessian, gradient, cost, inliers};
}

}  // namespace

#ifndef SPS_CUDA
STABLE_TORCH_LIBRARY_FRAGMENT(spslam, m) {
  m.def("predict_pose(Tensor before, Tensor last) -> Tensor");
  m.def("track_gauss_newton(" SPS_SCENE_SCHEMA
        ", Tensor pixels, Tensor pose, float[] intrinsics, int num_pixels, int iterations, float truncation, "
        "float kernel_start, float kernel_end, float score_kernel, float damping, int seed, int stream, int frame, "
        "float noise_crossover_depth, Tensor? reference, Tensor? reference_pose, float[] reference_intrinsics, "
        "float intensity_weight, float intensity_kernel, Tensor? views, Tensor? view_poses, int[] view_rows, "
        "float[] view_intrinsics, float depth_image_unit, float view_kernel_end, int view_first_iteration, bool tf32=True) -> "
        "(Tensor, Tensor, Tensor)");
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
