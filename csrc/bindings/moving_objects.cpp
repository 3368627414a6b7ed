#include "spslam/moving_objects.h"

#include <limits>
#include <tuple>

#include "bindings/common.h"
#include "bindings/number_list.h"

namespace spslam::bindings {
namespace {

constexpr char kFind[] = "find_moving_cells";
constexpr char kLeaveOut[] = "leave_out_moving";

// Places in the lists; spslam/ops/comparison.py fills them.
enum class GridScalar { kFx, kFy, kCx, kCy, kUnit, kMargin, kTurn, kDeviations, kCount };
enum class SampleInteger { kImageStep, kThumbnailStep, kStep, kFewest, kCount };
enum class SampleScalar { kLeast, kMost, kCount };

std::tuple<Tensor, Tensor> find_moving_cells(Tensor depth, Tensor pose, Tensor earlier, Tensor poses, Tensor noise,
                                             std::vector<double> scalar_list, std::int64_t step,
                                             std::vector<std::int64_t> rows) {
  const Scalars<GridScalar> scalars(kFind, "scalars", scalar_list);
  check_count(kFind, "step", step, 1);
  SPS_CHECK(depth.dim() == 2 && earlier.dim() == 3, kFind, ": depth must have shape [H, W] and earlier [S, h, w]");
  SPS_CHECK(pose.numel() == kPoseSize && noise.numel() >= 2, kFind, ": pose must have shape [7] and noise [2]");
  SPS_CHECK(poses.dim() == 2 && poses.size(1) == kPoseSize, kFind, ": poses must have shape [F, 7]");
  SPS_CHECK(earlier.size(1) >= 1 && earlier.size(2) >= 1, kFind, ": earlier must have cells");
  const std::int64_t num_earlier = static_cast<std::int64_t>(rows.size()) / 2;
  SPS_CHECK(num_earlier <= kMaxEarlierGrids, kFind, ": too many earlier frames");
  DeviceScope scope(depth);
  depth = as_contiguous(depth), pose = as_contiguous(pose), noise = as_contiguous(noise);
  earlier = as_contiguous(earlier), poses = as_contiguous(poses);
  DepthGrids grids{};
  grids.depth = data<std::uint16_t>(depth), grids.pose = data<float>(pose);
  grids.earlier = data<std::uint16_t>(earlier), grids.poses = data<float>(poses), grids.noise = data<float>(noise);
  grids.height = depth.size(0), grids.width = depth.size(1), grids.step = step;
  grids.rows = earlier.size(1), grids.columns = earlier.size(2);
  SPS_CHECK(grids.rows * grids.columns <= std::numeric_limits<std::int32_t>::max(), kFind, ": too many cells");
  SPS_CHECK((grids.rows - 1) * step < grids.height && (grids.columns - 1) * step < grids.width, kFind,
            ": the depth image must hold the cells");
  grids.intrinsics = load_intrinsics(
      kFind, {scalars[GridScalar::kFx], scalars[GridScalar::kFy], scalars[GridScalar::kCx], scalars[GridScalar::kCy]});
  grids.unit = scalars[GridScalar::kUnit];
  grids.margin = scalars[GridScalar::kMargin], grids.turn = scalars[GridScalar::kTurn];
  grids.deviations = scalars[GridScalar::kDeviations];
  grids.num_earlier = num_earlier;
  for (std::int64_t i = 0; i < num_earlier; ++i) {
    const std::int64_t slot = rows[static_cast<std::size_t>(2 * i)], frame = rows[static_cast<std::size_t>(2 * i + 1)];
    SPS_CHECK(slot >= 0 && slot < earlier.size(0) && frame >= 0 && frame < poses.size(0), kFind,
              ": rows must name cells and poses that are there");
    grids.slots[i] = static_cast<std::int32_t>(slot), grids.frames[i] = static_cast<std::int32_t>(frame);
  }
  Tensor cells = empty(depth, {grids.rows, grids.columns}, ScalarType::Byte);
  Tensor counts = empty(depth, {2}, ScalarType::Int);
  Tensor workspace = empty(depth, {moving_cells_workspace_size(grids)}, ScalarType::Byte);
  spslam::find_moving_cells(scope.context, grids, workspace.mutable_data_ptr(), mutable_data<std::uint8_t>(cells),
                            mutable_data<std::int32_t>(counts));
  return {cells, counts};
}

std::tuple<Tensor, Tensor, Tensor, Tensor> leave_out_moving(Tensor records, Tensor normals, Tensor depth,
                                                            Tensor thumbnail, Tensor cells, Tensor counts,
                                                            std::vector<double> scalar_list,
                                                            std::vector<std::int64_t> integer_list) {
  const Integers<SampleInteger> integers(kLeaveOut, "integers", integer_list);
  const Scalars<SampleScalar> scalars(kLeaveOut, "scalars", scalar_list);
  SPS_CHECK(records.dim() == 2 && records.size(1) == 3 && normals.dim() == 2 && normals.size(0) == records.size(0) &&
                normals.size(1) == 3,
            kLeaveOut, ": records and normals must have shape [P, 3]");
  SPS_CHECK(depth.dim() == 2 && thumbnail.dim() == 2 && cells.dim() == 2 && counts.numel() == 2, kLeaveOut,
            ": depth, thumbnail and cells must have two dimensions, and counts [2]");
  SPS_CHECK(records.size(0) >= 1 && cells.size(0) >= 1 && cells.size(1) >= 1, kLeaveOut,
            ": there must be records and cells");
  SPS_CHECK(thumbnail.scalar_type() == ScalarType::Half, kLeaveOut, ": thumbnail must be float16");
  DeviceScope scope(records);
  counts = as_contiguous(counts);
  records = as_contiguous(records), normals = as_contiguous(normals), depth = as_contiguous(depth);
  thumbnail = as_contiguous(thumbnail), cells = as_contiguous(cells);
  FrameSamples samples{};
  samples.records = data<std::int32_t>(records), samples.normals = data<float>(normals);
  samples.depth = data<std::uint16_t>(depth);
  samples.thumbnail = static_cast<const std::uint16_t*>(thumbnail.const_data_ptr());
  samples.num_records = records.size(0), samples.height = depth.size(0), samples.width = depth.size(1);
  samples.thumbnail_rows = thumbnail.size(0), samples.thumbnail_columns = thumbnail.size(1);
  samples.image_step = integers[SampleInteger::kImageStep];
  samples.thumbnail_step = integers[SampleInteger::kThumbnailStep];
  samples.step = integers[SampleInteger::kStep];
  check_count(kLeaveOut, "image_step", samples.image_step, 1);
  check_count(kLeaveOut, "thumbnail_step", samples.thumbnail_step, 1);
  check_count(kLeaveOut, "step", samples.step, 1);
  samples.rows = cells.size(0), samples.columns = cells.size(1);
  samples.least = scalars[SampleScalar::kLeast], samples.most = scalars[SampleScalar::kMost];
  samples.fewest = integers[SampleInteger::kFewest];
  check_count(kLeaveOut, "fewest", samples.fewest, 1);
  Tensor other_records = empty(records, {samples.num_records, 3}, ScalarType::Int);
  Tensor other_normals = empty(records, {samples.num_records, 3}, ScalarType::Float);
  Tensor other_depth = empty(records, {samples.height, samples.width}, ScalarType::UInt16);
  Tensor other_thumbnail = empty(records, {samples.thumbnail_rows, samples.thumbnail_columns}, ScalarType::Half);
  Tensor places = empty(records, {2 * samples.num_records + 1}, ScalarType::Int);
  spslam::leave_out_moving(scope.context, samples, data<std::uint8_t>(cells), data<std::int32_t>(counts),
                           mutable_data<std::int32_t>(places), mutable_data<std::int32_t>(other_records),
                           mutable_data<float>(other_normals), mutable_data<std::uint16_t>(other_depth),
                           static_cast<std::uint16_t*>(other_thumbnail.mutable_data_ptr()));
  return {other_records, other_normals, other_depth, other_thumbnail};
}

}  // namespace

#ifndef SPS_CUDA
STABLE_TORCH_LIBRARY_FRAGMENT(spslam, m) {
  m.def(
      "find_moving_cells(Tensor depth, Tensor pose, Tensor earlier, Tensor poses, Tensor noise, float[] scalars, "
      "int step, int[] rows) -> (Tensor, Tensor)");
  m.def(
      "leave_out_moving(Tensor records, Tensor normals, Tensor depth, Tensor thumbnail, Tensor cells, Tensor counts, "
      "float[] scalars, int[] integers) -> (Tensor, Tensor, Tensor, Tensor)");
}
#endif

SPS_LIBRARY_IMPL(m) {
  m.impl("find_moving_cells", TORCH_BOX(&find_moving_cells));
  m.impl("leave_out_moving", TORCH_BOX(&leave_out_moving));
}

}  // namespace spslam::bindings
