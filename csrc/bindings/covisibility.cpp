#include "spslam/covisibility.h"

#include "bindings/frame_thumbnails.h"
#include "bindings/number_list.h"

namespace spslam::bindings {
namespace {

Tensor frame_overlap(Tensor points, Tensor poses, Tensor depth_thumbnails, std::vector<double> intrinsics,
                     std::int64_t thumbnail_step) {
  SPS_CHECK(points.dim() == 2 && points.size(1) == 3, "frame_overlap: points must have shape [N, 3]");
  DeviceScope scope(points);
  const FramesArgument argument("frame_overlap", poses, depth_thumbnails, intrinsics, thumbnail_step);
  points = as_contiguous(points);
  Tensor share = empty(points, {argument.frames.num_frames}, ScalarType::Float);
  spslam::frame_overlap(scope.context, data<float>(points), points.size(0), argument.frames,
                        mutable_data<float>(share));
  return share;
}

// Places in the list of integers of select_covisible_frames; spslam/ops/covisibility.py fills them.
enum class Integer { kCurrent, kThumbnailStep, kNumPoints, kNumCovisible, kMostFrames, kSeed, kStream, kFrame, kCount };

Tensor select_covisible_frames(Tensor records, Tensor poses, Tensor depth_thumbnails, Tensor candidates,
                               std::vector<double> intrinsics, double threshold,
                               std::vector<std::int64_t> integer_list) {
  constexpr char kName[] = "select_covisible_frames";
  const Integers<Integer> integers(kName, "integers", integer_list);
  const std::int64_t current = integers[Integer::kCurrent], most = integers[Integer::kMostFrames];
  SPS_CHECK(records.dim() == 2 && records.size(1) == 3 && records.size(0) > 0, kName,
            ": records must have shape [P, 3] with P >= 1");
  SPS_CHECK(current >= 0 && current < poses.size(0), kName, ": current must be a row of poses");
  check_count(kName, "num_points", integers[Integer::kNumPoints], 0);
  SPS_CHECK(integers[Integer::kNumCovisible] >= 0 && most >= 0 && threshold >= 0.0 && threshold <= 1.0, kName,
            ": num_covisible and count must be at least 0, threshold in [0, 1]");
  SPS_CHECK(candidates.dim() == 1, kName, ": candidates must have shape [M]");
  DeviceScope scope(poses);
  const FramesArgument argument(kName, poses, depth_thumbnails, intrinsics, integers[Integer::kThumbnailStep]);
  records = as_contiguous(records);
  candidates = as_contiguous(candidates);
  const std::int64_t num_candidates = candidates.numel();
  const CovisibleSelection selection{current,
                                     integers[Integer::kNumPoints],
                                     integers[Integer::kNumCovisible],
                                     most < num_candidates ? most : num_candidates,
                                     threshold,
                                     load_key(integers, 0)};
  Tensor selected = empty(candidates, {selection.count}, ScalarType::Long);
  Tensor workspace = empty(poses, {covisible_workspace_size(scope.context, argument.frames, num_candidates, selection)},
                           ScalarType::Byte);
  spslam::select_covisible_frames(scope.context, data<std::int32_t>(records), records.size(0), argument.frames,
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
      "select_covisible_frames(Tensor records, Tensor poses, Tensor depth_thumbnails, Tensor candidates, "
      "float[] intrinsics, float threshold, int[] integers) -> Tensor");
}
#endif

SPS_LIBRARY_IMPL(m) {
  m.impl("frame_overlap", TORCH_BOX(&frame_overlap));
  m.impl("select_covisible_frames", TORCH_BOX(&select_covisible_frames));
}

}  // namespace spslam::bindings
