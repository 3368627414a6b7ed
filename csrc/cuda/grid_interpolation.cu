#include "core/cuda_check.cuh"
#include "core/fixed_point.cuh"
#include "core/for_each.h"
#include "kernels/grid_stencils.h"

namespace spslam {
namespace {

// Most threads that share a point's channels; a power of two.
constexpr int kMaxLanes = 8;

int lanes_of(std::int64_t channels) {
  int lanes = 1;
  while (lanes < channels && lanes < kMaxLanes) lanes *= 2;
  return lanes;
}

template <class T>
void fill_zero(Cuda device, std::int64_t count, T* out) {
  if (count > 0) SPS_CUDA_CHECK(cudaMemsetAsync(out, 0, count * sizeof(T), static_cast<cudaStream_t>(device.stream)));
}

// Sum over the lanes of one point, in a fixed order. The lanes of a point are always active together.
template <class T>
__device__ T sum_lanes(T value, int lanes) {
  const unsigned active = ((1u << lanes) - 1u) << (threadIdx.x % 32 / lanes * lanes);
  for (int offset = lanes / 2; offset; offset /= 2) value += __shfl_xor_sync(active, value, offset);
  return value;
}

// out[n] = sum of weight * row, for every level.
template <template <class> class Field, class T>
void gather_levels(Cuda device, const GridLevels<T>& all, const GridTable<T>& rows, const T* points,
                   std::int64_t num_points, T* out) {
  const GridLevels<T> grid = all;
  const GridTable<T> table = rows;
  const int lanes = lanes_of(table.channels);
  // Levels with channels of their own are points of their own.
  const std::int64_t turns = grid.concatenated ? grid.count : 1, levels = grid.concatenated ? 1 : grid.count;
  for_each(device, num_points * turns * lanes, [=] __device__(std::int64_t i) {
    const std::int64_t place = i / lanes, n = place / turns, first = place % turns;
    for (std::int64_t level = first; level < first + levels; ++level) {
      typename Field<T>::Stencil stencil;
      Field<T>{points, grid.levels[level]}.load(n, stencil);
      for (std::int64_t c = i % lanes; c < table.channels; c += lanes) {
        T sum = 0;
        for (int k = 0; k < Field<T>::kRows; ++k) {
          sum += stencil.weights[k] * table.rows[stencil.rows[k] * table.channels + c];
        }
        T* const value = out + place * table.channels + c;
        *value = level > first ? *value + sum : sum;
      }
    }
  });
}

template <template <class> class Field, class T>
void gather_level_gradients(Cuda device, const GridLevels<T>& all, const GridTable<T>& rows, const T* points,
                            std::int64_t num_points, const T* grad, T* out) {
  const GridLevels<T> grid = all;
  const GridTable<T> table = rows;
  const int lanes = lanes_of(table.channels);
  const std::int64_t stride = table.channels * (grid.concatenated ? grid.count : 1);
  for_each(device, num_points * lanes, [=] __device__(std::int64_t i) {
    const std::int64_t n = i / lanes;
    Vec3<T> sum{0, 0, 0};
    for (int level = 0; level < grid.count; ++level) {
      typename Field<T>::Stencil stencil;
      Field<T>{points, grid.levels[level]}.load(n, stencil);
      const T* const g = grad + n * stride + (grid.concatenated ? level * table.channels : 0);
      for (std::int64_t c = i % lanes; c < table.channels; c += lanes) {
        T values[Field<T>::kRows];
        for (int k = 0; k < Field<T>::kRows; ++k) values[k] = table.rows[stencil.rows[k] * table.channels + c];
        sum = sum + g[c] * stencil.gradient(values);
      }
    }
    const T coords[3] = {sum_lanes(sum.x, lanes), sum_lanes(sum.y, lanes), sum_lanes(sum.z, lanes)};
    if (i % lanes == 0) {
      for (int axis = 0; axis < 3; ++axis) out[3 * n + axis] = coords[axis];
    }
  });
}

// Adds in fixed point what add(fixed, sums) says for each of `count` elements, and stores the sums.
template <class T, class Add>
void sum_fixed(Cuda device, std::int64_t count, std::int64_t terms, std::int64_t size, const std::int64_t* largest,
               std::int64_t* sums, T* out, const Add& add) {
  std::int64_t* const bits = const_cast<std::int64_t*>(largest);
  for_each(device, count, [=] __device__(std::int64_t i) { add(FixedPoint(bits, terms), sums, i); });
  for_each(device, size,
           [=] __device__(std::int64_t i) { out[i] = static_cast<T>(FixedPoint(bits, terms).value(sums[i])); });
}

template <template <class> class Field, class T>
void scatter_levels(Cuda device, const GridLevels<T>& all, const GridTable<T>& rows, const T* points,
                    std::int64_t num_points, const T* grad, T* out, std::int64_t* workspace) {
  const GridLevels<T> grid = all;
  const std::int64_t channels = rows.channels, size = rows.num_rows * channels, turns = grid.count;
  const std::int64_t stride = channels * (grid.concatenated ? grid.count : 1);
  const int lanes = lanes_of(channels);
  std::int64_t* const largest = workspace + size;
  fill_zero(device, size + 1, workspace);
  max_abs(device, num_points * stride, grad, largest);
  sum_fixed(device, num_points * turns * lanes, num_points * Field<T>::kRows, size, largest, workspace, out,
            [=] __device__(const FixedPoint& fixed, std::int64_t* sums, std::int64_t i) {
              const std::int64_t place = i / lanes, n = place / turns, level = place % turns;
              typename Field<T>::Stencil stencil;
              Field<T>{points, grid.levels[level]}.load(n, stencil);
              const T* const g = grad + n * stride + (grid.concatenated ? level * channels : 0);
              for (std::int64_t c = i % lanes; c < channels; c += lanes) {
                const double term = g[c];
                for (int k = 0; k < Field<T>::kRows; ++k) {
                  fixed.add(sums + stencil.rows[k] * channels + c, stencil.weights[k] * term);
                }
              }
            });
}

}  // namespace

template <>
std::int64_t grid_workspace_words<Cuda>(std::int64_t table_size) {
  return table_size + 1;
}

template <class Device, class T>
void grid_interpolate(Device device, const GridLevels<T>& grid, const GridTable<T>& table, const T* points,
                      std::int64_t num_points, T* out) {
  if (grid.kind == GridKind::kTriPlanes) {
    gather_levels<PlaneLevelField>(device, grid, table, points, num_points, out);
  } else {
    gather_levels<VolumeLevelField>(device, grid, table, points, num_points, out);
  }
}

template <class Device, class T>
void grid_interpolate_backward(Device device, const GridLevels<T>& grid, const GridTable<T>& table, const T* points,
                               std::int64_t num_points, const T* grad, T* grad_table, T* grad_points,
                               std::int64_t* workspace) {
  if (grid.kind == GridKind::kTriPlanes) {
    if (grad_table) {
      scatter_levels<PlaneLevelField>(device, grid, table, points, num_points, grad, grad_table, workspace);
    }
    if (grad_points) {
      gather_level_gradients<PlaneLevelField>(device, grid, table, points, num_points, grad, grad_points);
    }
  } else {
    if (grad_table) {
      scatter_levels<VolumeLevelField>(device, grid, table, points, num_points, grad, grad_table, workspace);
    }
    if (grad_points) {
      gather_level_gradients<VolumeLevelField>(device, grid, table, points, num_points, grad, grad_points);
    }
  }
}

template <class Device, class T>
void row_gather(Device device, const RowLists& lists, const T* table, const T* weights, T* out) {
  const RowLists l = lists;
  for_each(device, l.num_lists * l.channels, [=] __device__(std::int64_t i) {
    const std::int64_t n = i / l.channels, c = i % l.channels;
    T sum = 0;
    for (std::int64_t at = n * l.length; at < (n + 1) * l.length; ++at) {
      if (valid_row(l.rows[at], l.num_rows)) sum += weights[at] * table[l.rows[at] * l.channels + c];
    }
    out[i] = sum;
  });
}

template <class Device, class T>
void row_scatter(Device device, const RowLists& lists, const T* grad, const T* weights, T* out,
                 std::int64_t* workspace) {
  const RowLists l = lists;
  const std::int64_t size = l.num_rows * l.channels, pairs = l.num_lists * l.length;
  std::int64_t* const largest = workspace + size;
  std::int64_t* const largest_weight = largest + 1;
  fill_zero(device, size + 2, workspace);
  // Of rows in the table: gradients and weights of others, which may be no numbers, go nowhere.
  max_abs_of(
      device, l.num_lists * l.channels,
      [=] __device__(std::int64_t i) {
        const std::int64_t n = i / l.channels;
        bool any = false;
        for (std::int64_t at = n * l.length; at < (n + 1) * l.length; ++at) any |= valid_row(l.rows[at], l.num_rows);
        return any ? grad[i] : T(0);
      },
      largest);
  max_abs_of(
      device, pairs, [=] __device__(std::int64_t i) { return valid_row(l.rows[i], l.num_rows) ? weights[i] : T(0); },
      largest_weight);
  // Unlike those of interpolation, weights may be of any size, so the bound of a term is a product.
  for_each(device, 1, [=] __device__(std::int64_t) {
    const double bound = __longlong_as_double(*largest) * __longlong_as_double(*largest_weight);
    *largest = __double_as_longlong(bound);
  });
  sum_fixed(device, pairs * l.channels, pairs, size, largest, workspace, out,
            [=] __device__(const FixedPoint& fixed, std::int64_t* sums, std::int64_t i) {
              const std::int64_t at = i / l.channels, c = i % l.channels;
              if (!valid_row(l.rows[at], l.num_rows)) return;
              const double g = grad[at / l.length * l.channels + c];
              fixed.add(sums + l.rows[at] * l.channels + c, static_cast<double>(weights[at]) * g);
            });
}

template <class Device, class T>
void row_dot(Device device, const RowLists& lists, const T* grad, const T* table, T* out) {
  const RowLists l = lists;
  for_each(device, l.num_lists * l.length, [=] __device__(std::int64_t i) {
    T sum = 0;
    if (valid_row(l.rows[i], l.num_rows)) {
      const T *g = grad + i / l.length * l.channels, *row = table + l.rows[i] * l.channels;
      for (std::int64_t c = 0; c < l.channels; ++c) sum += g[c] * row[c];
    }
    out[i] = sum;
  });
}

#define SPS_INSTANTIATE_GRIDS(T)                                                                                   \
  template void grid_interpolate<Cuda, T>(Cuda, const GridLevels<T>&, const GridTable<T>&, const T*, std::int64_t, \
                                          T*);                                                                     \
  template void grid_interpolate_backward<Cuda, T>(Cuda, const GridLevels<T>&, const GridTable<T>&, const T*,      \
                                                   std::int64_t, const T*, T*, T*, std::int64_t*);                 \
  template void row_gather<Cuda, T>(Cuda, const RowLists&, const T*, const T*, T*);                                \
  template void row_scatter<Cuda, T>(Cuda, const RowLists&, const T*, const T*, T*, std::int64_t*);                \
  template void row_dot<Cuda, T>(Cuda, const RowLists&, const T*, const T*, T*);
SPS_INSTANTIATE_GRIDS(float)
SPS_INSTANTIATE_GRIDS(double)

}  // namespace spslam
