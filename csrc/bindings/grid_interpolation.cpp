#include "spslam/grid_interpolation.h"

#include "bindings/common.h"

namespace spslam::bindings {
namespace {

using Integers = std::vector<std::int64_t>;
using Floats = std::vector<double>;

constexpr int kLevelIntegers = 7, kLevelFloats = 6;
constexpr std::int64_t kFarthest = std::int64_t{1} << 30;

// Rows of a table that begin at `offset` must lie within it.
void check_region(const char* function, std::int64_t offset, std::int64_t count, std::int64_t rows) {
  SPS_CHECK(offset >= 0 && offset <= rows && count >= 0 && count <= rows - offset, function,
            ": levels must lie within the ", rows, " rows of the table, got ", count, " from ", offset);
}

// From 7 integers for each level, (offset of xy or of a volume, of xz, of yz, size_x, size_y, size_z, hash_rows), and 6
// floats, (scale, shift) of x, y and z.
template <class T>
GridLevels<T> load_levels(const char* function, const Integers& integers, const Floats& floats, std::int64_t kind,
                          bool concatenated, std::int64_t rows) {
  const std::size_t count = integers.size() / kLevelIntegers;
  SPS_CHECK(count >= 1 && count <= kMaxGridLevels && integers.size() == count * kLevelIntegers &&
                floats.size() == count * kLevelFloats && (kind == 0 || kind == 1),
            function, ": levels must be 1 to 16, of 7 integers and 6 numbers each");
  GridLevels<T> grid{};
  grid.count = static_cast<std::int32_t>(count);
  grid.kind = static_cast<GridKind>(kind);
  grid.concatenated = concatenated;
  for (std::size_t l = 0; l < count; ++l) {
    const std::int64_t* n = integers.data() + l * kLevelIntegers;
    const std::int64_t *size = n + 3, hash_rows = n[6];
    GridLevel<T>& level = grid.levels[l];
    for (int axis = 0; axis < 3; ++axis) {
      SPS_CHECK(size[axis] >= 1 && size[axis] <= kFarthest, function, ": sizes of a level must be in [1, 2^30], got ",
                size[axis]);
      level.offset[axis] = n[axis];
      level.size[axis] = static_cast<std::int32_t>(size[axis]);
      level.scale[axis] = static_cast<T>(floats[l * kLevelFloats + static_cast<std::size_t>(2 * axis)]);
      level.shift[axis] = static_cast<T>(floats[l * kLevelFloats + static_cast<std::size_t>(2 * axis + 1)]);
    }
    level.hash_rows = static_cast<std::int32_t>(hash_rows);
    if (grid.kind == GridKind::kTriPlanes) {
      check_region(function, n[0], size[0] * size[1], rows);
      check_region(function, n[1], size[0] * size[2], rows);
      check_region(function, n[2], size[1] * size[2], rows);
    } else if (hash_rows) {
      SPS_CHECK(hash_rows > 0 && hash_rows <= kFarthest && (hash_rows & (hash_rows - 1)) == 0, function,
                ": hashed rows must be a power of two up to 2^30, got ", hash_rows);
      check_region(function, n[0], hash_rows, rows);
    } else {
      const std::int64_t plane = size[1] * size[2];  // within 2^60
      check_region(function, n[0], plane <= rows && size[0] <= rows ? size[0] * plane : kMaxCount * kMaxCount, rows);
    }
  }
  return grid;
}

struct Arguments {
  Tensor table, points;
  std::int64_t channels, num_points, width;

  Arguments(const char* function, const Tensor& table_, const Tensor& points_, const Integers& integers,
            bool concatenated)
      : table(as_contiguous(table_)), points(as_contiguous(points_)) {
    SPS_CHECK(table.dim() == 2 && has_shape(points, {-1, 3}), function, ": shapes must be [P, C], [N, 3]");
    channels = table.size(1);
    num_points = points.size(0);
    width = concatenated ? channels * static_cast<std::int64_t>(integers.size() / kLevelIntegers) : channels;
  }

  template <class T>
  GridTable<T> rows() const {
    return {data<T>(table), table.size(0), channels};
  }
};

Tensor grid_interpolate(Tensor table, Tensor points, Integers levels, Floats transforms, std::int64_t kind,
                        bool concatenated) {
  const char* name = "grid_interpolate";
  const Arguments in(name, table, points, levels, concatenated);
  DeviceScope scope(table);
  Tensor out = empty(table, {in.num_points, in.width}, table.scalar_type());
  dispatch_floating(name, table, [&](auto zero) {
    using T = decltype(zero);
    const auto grid = load_levels<T>(name, levels, transforms, kind, concatenated, in.table.size(0));
    spslam::grid_interpolate(scope.context, grid, in.rows<T>(), data<T>(in.points), in.num_points,
                             mutable_data<T>(out));
  });
  return out;
}

std::tuple<Tensor, Tensor> grid_interpolate_backward(Tensor grad, Tensor table, Tensor points, Integers levels,
                                                     Floats transforms, std::int64_t kind, bool concatenated,
                                                     bool need_table, bool need_points) {
  const char* name = "grid_interpolate_backward";
  const Arguments in(name, table, points, levels, concatenated);
  SPS_CHECK(has_shape(grad, {in.num_points, in.width}), name, ": grad must fit the output");
  DeviceScope scope(table);
  grad = as_contiguous(grad);
  const ScalarType dtype = table.scalar_type();
  const Integers none{0};
  Tensor to_table = empty(table, need_table ? Integers{in.table.size(0), in.channels} : none, dtype);
  Tensor to_points = empty(table, need_points ? Integers{in.num_points, 3} : none, dtype);
  Tensor workspace = empty(table, {need_table ? grid_workspace_words<Context>(in.table.numel()) : 0}, ScalarType::Long);
  dispatch_floating(name, table, [&](auto zero) {
    using T = decltype(zero);
    const auto grid = load_levels<T>(name, levels, transforms, kind, concatenated, in.table.size(0));
    spslam::grid_interpolate_backward(scope.context, grid, in.rows<T>(), data<T>(in.points), in.num_points,
                                      data<T>(grad), need_table ? mutable_data<T>(to_table) : nullptr,
                                      need_points ? mutable_data<T>(to_points) : nullptr,
                                      mutable_data<std::int64_t>(workspace));
  });
  return {to_table, to_points};
}

RowLists row_lists(const Tensor& rows, std::int64_t num_rows, std::int64_t channels) {
  SPS_CHECK(rows.dim() == 2, "row_gather: rows must have shape [N, K]");
  return {data<std::int32_t>(rows), rows.size(0), rows.size(1), num_rows, channels};
}

Tensor row_gather(Tensor table, Tensor rows, Tensor weights) {
  SPS_CHECK(table.dim() == 2 && same_shape(rows, weights), "row_gather: shapes must be [P, C], [N, K], [N, K]");
  DeviceScope scope(table);
  table = as_contiguous(table);
  rows = as_contiguous(rows);
  weights = as_contiguous(weights);
  const RowLists lists = row_lists(rows, table.size(0), table.size(1));
  Tensor out = empty(table, {lists.num_lists, lists.channels}, table.scalar_type());
  dispatch_floating("row_gather", table, [&](auto zero) {
    using T = decltype(zero);
    spslam::row_gather(scope.context, lists, data<T>(table), data<T>(weights), mutable_data<T>(out));
  });
  return out;
}

Tensor row_scatter(Tensor grad, Tensor rows, Tensor weights, std::int64_t num_rows) {
  check_count("row_scatter", "num_rows", num_rows, 0);
  SPS_CHECK(grad.dim() == 2 && same_shape(rows, weights) && rows.dim() == 2 && grad.size(0) == rows.size(0),
            "row_scatter: shapes must be [N, C], [N, K], [N, K]");
  DeviceScope scope(grad);
  grad = as_contiguous(grad);
  rows = as_contiguous(rows);
  weights = as_contiguous(weights);
  const RowLists lists = row_lists(rows, num_rows, grad.size(1));
  Tensor out = empty(grad, {num_rows, lists.channels}, grad.scalar_type());
  const std::int64_t words = grid_workspace_words<Context>(num_rows * lists.channels);
  Tensor workspace = empty(grad, {words ? words + 1 : 0}, ScalarType::Long);
  dispatch_floating("row_scatter", grad, [&](auto zero) {
    using T = decltype(zero);
    spslam::row_scatter(scope.context, lists, data<T>(grad), data<T>(weights), mutable_data<T>(out),
                        mutable_data<std::int64_t>(workspace));
  });
  return out;
}

Tensor row_dot(Tensor grad, Tensor table, Tensor rows) {
  SPS_CHECK(grad.dim() == 2 && table.dim() == 2 && rows.dim() == 2 && grad.size(0) == rows.size(0) &&
                grad.size(1) == table.size(1),
            "row_dot: shapes must be [N, C], [P, C], [N, K]");
  DeviceScope scope(grad);
  grad = as_contiguous(grad);
  table = as_contiguous(table);
  rows = as_contiguous(rows);
  const RowLists lists = row_lists(rows, table.size(0), table.size(1));
  Tensor out = empty(grad, {lists.num_lists, lists.length}, grad.scalar_type());
  dispatch_floating("row_dot", grad, [&](auto zero) {
    using T = decltype(zero);
    spslam::row_dot(scope.context, lists, data<T>(grad), data<T>(table), mutable_data<T>(out));
  });
  return out;
}

}  // namespace

#ifndef SPS_CUDA
STABLE_TORCH_LIBRARY_FRAGMENT(spslam, m) {
  m.def(
      "grid_interpolate(Tensor table, Tensor points, int[] levels, float[] transforms, int kind, bool concatenated) "
      "-> Tensor");
  m.def(
      "grid_interpolate_backward(Tensor grad, Tensor table, Tensor points, int[] levels, float[] transforms, int kind, "
      "bool concatenated, bool need_table=True, bool need_points=True) -> (Tensor, Tensor)");
  m.def("row_gather(Tensor table, Tensor rows, Tensor weights) -> Tensor");
  m.def("row_scatter(Tensor grad, Tensor rows, Tensor weights, int num_rows) -> Tensor");
  m.def("row_dot(Tensor grad, Tensor table, Tensor rows) -> Tensor");
}
#endif

SPS_LIBRARY_IMPL(m) {
  m.impl("grid_interpolate", TORCH_BOX(&grid_interpolate));
  m.impl("grid_interpolate_backward", TORCH_BOX(&grid_interpolate_backward));
  m.impl("row_gather", TORCH_BOX(&row_gather));
  m.impl("row_scatter", TORCH_BOX(&row_scatter));
  m.impl("row_dot", TORCH_BOX(&row_dot));
}

}  // namespace spslam::bindings
