#include "spslam/marching_cubes.h"

#include "bindings/common.h"

namespace spslam::bindings {
namespace {

// The third output says what is wrong with the coordinates: see MarchingCubesCounts.
std::tuple<Tensor, Tensor, std::int64_t> marching_cubes(Tensor cell_coords, Tensor values, double level) {
  constexpr std::int64_t kMaxSamples = 1025;  // an axis: a cell's samples are counted in 32 bits
  SPS_CHECK(has_shape(values, {-1, -1, -1, -1}) && values.size(1) == values.size(2) &&
                values.size(2) == values.size(3) && has_shape(cell_coords, {values.size(0), 3}),
            "marching_cubes: cell_coords and values must have shapes [M, 3] and [M, n + 1, n + 1, n + 1]");
  SPS_CHECK(values.size(1) >= 2 && values.size(1) <= kMaxSamples, "marching_cubes: values must have 2 to ", kMaxSamples,
            " samples per axis, got ", values.size(1));
  DeviceScope scope(values);
  cell_coords = as_contiguous(cell_coords);
  values = as_contiguous(values);
  const MarchingCubesCells cells{data<std::int32_t>(cell_coords), data<float>(values), values.size(0),
                                 static_cast<int>(values.size(1) - 1), static_cast<float>(level)};
  Tensor workspace =
      empty(values, {marching_cubes_workspace_bytes(scope.context, cells.count, cells.n)}, ScalarType::Byte);
  void* work = mutable_data<std::uint8_t>(workspace);
  const MarchingCubesCounts counts = marching_cubes_count(scope.context, cells, work);
  if (counts.faults != 0) {
    return {empty(values, {0, 3}, ScalarType::Float), empty(values, {0, 3}, ScalarType::Long),
            static_cast<std::int64_t>(counts.faults)};
  }
  Tensor vertices = empty(values, {counts.vertices, 3}, ScalarType::Float);
  Tensor faces = empty(values, {counts.faces, 3}, ScalarType::Long);
  marching_cubes_fill(scope.context, cells, work, mutable_data<float>(vertices), mutable_data<std::int64_t>(faces));
  return {vertices, faces, 0};
}

}  // namespace

#ifndef SPS_CUDA
STABLE_TORCH_LIBRARY_FRAGMENT(spslam, m) {
  m.def(
      "marching_cubes(Tensor cell_coords, Tensor values, float level) -> (Tensor vertices, Tensor faces, int faults)");
}
#endif

SPS_LIBRARY_IMPL(m) {
  m.impl("marching_cubes", TORCH_BOX(&marching_cubes));
}

}  // namespace spslam::bindings
