#include "spslam/known_surface.h"

#include <tuple>

#include "bindings/frame_thumbnails.h"
#include "bindings/number_list.h"

namespace spslam::bindings {
namespace {

constexpr char kName[] = "count_known_surface";

// Places in the lists; spslam/ops/comparison.py fills them.
enum class Integer { kThumbnailStep, kStep, kRows, kColumns, kMostRows, kCount };
enum class Scalar { kMeters, kShare, kClear, kCount };

std::tuple<Tensor, Tensor> count_known_surface(Tensor records, Tensor normals, Tensor pose, Tensor poses,
                                               Tensor depth_thumbnails, Tensor rows, std::vector<double> intrinsics,
                                               std::vector<double> scalar_list,
                                               std::vector<std::int64_t> integer_list) {
  const Integers<Integer> integers(kName, "integers", integer_list);
  const Scalars<Scalar> scalars(kName, "scalars", scalar_list);
  SPS_CHECK(records.dim() == 2 && records.size(1) == 3, kName, ": records must have shape [P, 3]");
  SPS_CHECK(normals.dim() == 2 && normals.size(0) == records.size(0) && normals.size(1) == 3, kName,
            ": normals must have shape [P, 3]");
  SPS_CHECK(pose.numel() == kPoseSize && rows.dim() == 1, kName, ": pose must have shape [7] and rows [M]");
  DeviceScope scope(poses);
  const FramesArgument argument(kName, poses, depth_thumbnails, intrinsics, integers[Integer::kThumbnailStep]);
  records = as_contiguous(records), normals = as_contiguous(normals);
  pose = as_contiguous(pose), rows = as_contiguous(rows);
  const ComparedFrame frame{data<std::int32_t>(records), data<float>(normals),     records.size(0),
                            data<float>(pose),           integers[Integer::kStep], integers[Integer::kRows],
                            integers[Integer::kColumns]};
  check_count(kName, "grid_step", frame.step, 1);
  check_count(kName, "grid_rows", frame.rows, 1);
  check_count(kName, "grid_columns", frame.columns, 1);
  check_count(kName, "cells of the grid", frame.rows * frame.columns, 1);
  const std::int64_t num_rows = rows.numel(), most = integers[Integer::kMostRows];
  const std::int64_t num_best = most < num_rows ? most : num_rows;
  SPS_CHECK(num_best >= 0, kName, ": the most rows must be at least 0");
  Tensor counts = empty(poses, {3}, ScalarType::Long);
  Tensor best = empty(poses, {num_best}, ScalarType::Long);
  Tensor workspace =
      empty(poses, {known_surface_workspace_size(scope.context, argument.frames, frame, num_rows)}, ScalarType::Byte);
  const SurfaceTolerance tolerance{scalars[Scalar::kMeters], scalars[Scalar::kShare], scalars[Scalar::kClear]};
  spslam::count_known_surface(scope.context, argument.frames, frame, tolerance, data<std::int64_t>(rows), num_rows,
                              num_best, workspace.mutable_data_ptr(), mutable_data<std::int64_t>(counts),
                              mutable_data<std::int64_t>(best));
  return {counts, best};
}

}  // namespace

#ifndef SPS_CUDA
STABLE_TORCH_LIBRARY_FRAGMENT(spslam, m) {
  m.def(
      "count_known_surface(Tensor records, Tensor normals, Tensor pose, Tensor poses, Tensor depth_thumbnails, "
      "Tensor rows, float[] intrinsics, float[] scalars, int[] integers) -> (Tensor, Tensor)");
}
#endif

SPS_LIBRARY_IMPL(m) {
  m.impl("count_known_surface", TORCH_BOX(&count_known_surface));
}

}  // namespace spslam::bindings
