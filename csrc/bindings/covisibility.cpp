#include "spslam/covisibility.h"

#include "bindings/scene.h"

namespace spslam::bindings {
namespace {

// Keeps the tensors alive while a kernel reads the views.
class KeyframesArgument {
 public:
  KeyframesArgument(const char* function, const Tensor& poses, const Tensor& depth_thumbnails,
                    const std::vector<double>& intrinsics, std::int64_t step)
      : poses_(torch::stable::contiguous(poses)), thumbnails_(torch::stable::contiguous(depth_thumbnails)) {
    SPS_CHECK(poses.dim() == 2 && poses.size(1) == kPoseSize, function, ": poses must have shape [F, 7]");
    SPS_CHECK(depth_thumbnails.dim() == 3 && depth_thumbnails.size(0) == poses.size(0) &&
                  depth_thumbnails.scalar_type() == ScalarType::Half,
              function, ": depth_thumbnails must be float16 of shape [F, h, w]");
    SPS_CHECK(step >= 1, function, ": thumbnail_step must be >= 1");
    views = {data<float>(poses_),
             static_cast<const std::uint16_t*>(thumbnails_.const_data_ptr()),
             poses.size(0),
             depth_thumbnails.size(1),
             depth_thumbnails.size(2),
             load_intrinsics(function, intrinsics),
             step};
  }

  FrameViews views;

 private:
  Tensor poses_, thumbnails_;
};

Tensor frame_overlap(Tensor points, Tensor poses, Tensor depth_thumbnails, std::vector<double> intrinsics,
                     std::int64_t thumbnail_step) {
  SPS_CHECK(points.dim() == 2 && points.size(1) == 3, "frame_overlap: points must have shape [N, 3]");
  DeviceScope scope(points);
  const KeyframesArgument argument("frame_overlap", poses, depth_thumbnails, intrinsics, thumbnail_step);
  points = torch::stable::contiguous(points);
  Tensor share = empty(points, {argument.views.num_frames}, ScalarType::Float);
  spslam::frame_overlap(scope.context, data<float>(points), points.size(0), argument.views, mutable_data<float>(share));
  return share;
}

Tensor select_covisible_frames(Tensor records, std::int64_t current, Tensor poses, Tensor depth_thumbnails,
                               Tensor candidates, std::vector<double> intrinsics, std::int64_t thumbnail_step,
                               std::int64_t num_points, std::int64_t num_covisible, std::int64_t count,
                               double threshold, std::int64_t seed, std::int64_t stream, std::int64_t frame) {
  SPS_CHECK(records.dim() == 2 && records.size(1) == 3 && records.size(0) > 0,
            "select_covisible_frames: records must have shape [P, 3] with P >= 1");
  SPS_CHECK(current >= 0 && current < poses.size(0), "select_covisible_frames: current must be a row of poses");
  DeviceScope scope(poses);
  const KeyframesArgument argument("select_covisible_frames", poses, depth_thumbnails, intrinsics, thumbnail_step);
  check_count("select_covisible_frames", "num_points", num_points, 0);
  SPS_CHECK(num_covisible >= 0 && count >= 0 && threshold >= 0.0 && threshold <= 1.0,
            "select_covisible_frames: num_covisible and count must be at least 0, threshold in [0, 1]");
  SPS_CHECK(candidates.dim() == 1, "select_covisible_frames: candidates must have shape [M]");
  records = torch::stable::contiguous(records);
  candidates = torch::stable::contiguous(candidates);
  const std::int64_t num_candidates = candidates.numel();
  const CovisibleSelection selection{current,       num_points,
                                     num_covisible, count < num_candidates ? count : num_candidates,
                                     threshold,     philox_key(seed, stream, frame, 0)};
  Tensor selected = empty(candidates, {selection.count}, ScalarType::Long);
  Tensor workspace = empty(poses, {covisible_workspace_size(scope.context, argument.views, num_candidates, selection)},
                           ScalarType::Byte);
  spslam::select_covisible_frames(scope.context, data<std::int32_t>(records), records.size(0), argument.views,
                                  data<std::int64_t>(candidates), num_candidates, selection,
                                  workspace.mutable_data_ptr(), mutable_data<std::int64_t>(selected));
  return selected;
}

}  // namespace

#ifndef SPS_CUDA
STABLE_TORCH_LIBRARY_FRAGMENT(spslam, m) {
  m.def(
      "frame_overlap(Tensor points, Tensor poses, Tensor depth_thumbnails, float[] intrinsics, int thumbnail_step) -> "
      "Tensor");
  m.def(
      "select_covisible_frames(Tensor records, int current, Tensor poses, Tensor depth_thumbnails, Tensor candidates, "
      "float[] intrinsics, int thumbnail_step, int num_points, int num_covisible, int count, float threshold, "
      "int seed, int stream, int frame) -> Tensor");
}
#endif

SPS_LIBRARY_IMPL(m) {
  m.impl("frame_overlap", TORCH_BOX(&frame_overlap));
  m.impl("select_covisible_frames", TORCH_BOX(&select_covisible_frames));
}

}  // namespace spslam::bindings
