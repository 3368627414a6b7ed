#include "spslam/brightness_sums.h"

#include "bindings/common.h"
#include "bindings/number_list.h"

namespace spslam::bindings {
namespace {

constexpr char kName[] = "brightness_sums";
constexpr std::int64_t kMostCellsInARow = 16;
constexpr std::int64_t kMostRows = 65535;  // blocks of a launch

// Places in the lists; spslam/ops/comparison.py fills them.
enum class Integer { kColumns, kRows, kCellsInARow, kPoints, kCount };
enum class Scalar { kFx, kFy, kCx, kCy, kImageFx, kImageFy, kImageCx, kImageCy, kUnit, kTolerance, kCount };

Tensor brightness_sums(Tensor records, Tensor poses, Tensor rows, Tensor pose, Tensor depth, Tensor intensity,
                       std::vector<double> scalar_list, std::vector<std::int64_t> integer_list) {
  const Integers<Integer> integers(kName, "integers", integer_list);
  const Scalars<Scalar> scalars(kName, "scalars", scalar_list);
  SPS_CHECK(records.dim() == 3 && records.size(2) == 3, kName, ": records must have shape [F, P, 3]");
  SPS_CHECK(has_shape(poses, {records.size(0), kPoseSize}), kName, ": poses must have shape [F, 7]");
  SPS_CHECK(rows.dim() == 1 && rows.size(0) <= kMostRows, kName, ": rows must have shape [M], M < 2^16");
  SPS_CHECK(pose.numel() == kPoseSize, kName, ": pose must have shape [7]");
  SPS_CHECK(depth.dim() == 2 && same_shape(depth, intensity), kName, ": depth and intensity must have shape [h, w]");
  for (const Integer place : {Integer::kColumns, Integer::kRows, Integer::kCellsInARow}) {
    check_count(kName, "image and cells", integers[place]);
  }
  SPS_CHECK(integers[Integer::kCellsInARow] <= kMostCellsInARow, kName, ": there must be at most 16 cells in a row");
  const std::int64_t points = integers[Integer::kPoints], num_records = records.size(1);
  SPS_CHECK(points >= 0, kName, ": points must be at least 0");
  DeviceScope scope(records);
  records = as_contiguous(records), poses = as_contiguous(poses), rows = as_contiguous(rows);
  pose = as_contiguous(pose), depth = as_contiguous(depth), intensity = as_contiguous(intensity);
  const SeenPixels seen{data<std::int32_t>(records),
                        data<float>(poses),
                        records.size(0),
                        num_records,
                        points < num_records ? points : num_records,
                        load_intrinsics(scalars),
                        integers[Integer::kColumns],
                        integers[Integer::kRows],
                        integers[Integer::kCellsInARow]};
  const Intrinsics of_images{scalars.as<float>(Scalar::kImageFx), scalars.as<float>(Scalar::kImageFy),
                             scalars.as<float>(Scalar::kImageCx), scalars.as<float>(Scalar::kImageCy)};
  const ShownImages shown{
      data<std::uint16_t>(depth), data<std::uint8_t>(intensity), depth.size(0), depth.size(1), of_images,
      scalars[Scalar::kUnit],     scalars[Scalar::kTolerance]};
  Tensor sums = empty(poses, {5}, ScalarType::Double);
  Scratch scratch(poses);
  void* workspace = scratch(brightness_workspace_size(scope.context, seen, rows.size(0)));
  sum_brightness(scope.context, seen, data<std::int64_t>(rows), rows.size(0), shown, data<float>(pose), workspace,
                 mutable_data<double>(sums));
  return sums;
}

}  // namespace

#ifndef SPS_CUDA
STABLE_TORCH_LIBRARY_FRAGMENT(spslam, m) {
  m.def(
      "brightness_sums(Tensor records, Tensor poses, Tensor rows, Tensor pose, Tensor depth, Tensor intensity, "
      "float[] scalars, int[] integers) -> Tensor");
}
#endif

SPS_LIBRARY_IMPL(m) {
  m.impl("brightness_sums", TORCH_BOX(&brightness_sums));
}

}  // namespace spslam::bindings
