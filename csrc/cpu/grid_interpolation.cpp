#include "spslam/grid_interpolation.h"

#include "cpu/interpolation_loops.h"
#include "kernels/grid_stencils.h"

namespace spslam {
namespace {

constexpr std::int64_t kFillGrain = 1 << 16;

// Calls f with a field of level `level`.
template <class T, class F>
void with_level(const GridLevels<T>& grid, std::int32_t level, const T* points, const F& f) {
  if (grid.kind == GridKind::kTriPlanes) {
    f(PlaneLevelField<T>{points, grid.levels[level]});
  } else {
    f(VolumeLevelField<T>{points, grid.levels[level]});
  }
}

template <class T>
std::int64_t output_width(const GridLevels<T>& grid, std::int64_t channels) {
  return grid.concatenated ? grid.count * channels : channels;
}

template <class T>
void fill_zero(std::int64_t count, T* out) {
  parallel_for(count, kFillGrain, [=](std::int64_t begin, std::int64_t end) {
    std::memset(out + begin, 0, static_cast<std::size_t>(end - begin) * sizeof(T));
  });
}

// Sums the gradient of the table: a row has one owner, which adds in the order of the points. Threads share the work by
// levels, by parts of a level, and by cache lines of its rows.
template <class T>
void scatter_levels(const GridLevels<T>& grid, const GridTable<T>& table, const T* points, std::int64_t num_points,
                    const T* grad, T* out) {
  fill_zero(table.num_rows * table.channels, out);
  const std::int64_t parts = grid.kind == GridKind::kTriPlanes ? 3 : 1, regions = parts * grid.count;
  const std::int64_t channels = table.channels,
                     width = slice_width<T>(channels, chunk_count(get_num_threads(), regions));
  const std::int64_t slices = width > 0 ? chunk_count(channels, width) : 0;
  const std::int64_t stride = output_width(grid, channels);
  parallel_for(regions * slices, 1, [&](std::int64_t begin, std::int64_t end) {
    for (std::int64_t task = begin; task < end; ++task) {
      const std::int64_t region = task / slices, first = task % slices * width;
      const std::int64_t count = std::min(width, channels - first);
      const auto level = static_cast<std::int32_t>(region / parts);
      const T* g = grad + (grid.concatenated ? level * channels : 0) + first;
      with_level(grid, level, points, [&](const auto& field) {
        with_channels<2, 4, 8, 16, 32>(count, [&](auto constant) {
          scatter_part<decltype(constant)::value>(field, static_cast<int>(region % parts), g, stride, channels, count,
                                                  num_points, out + first);
        });
      });
    }
  });
}

template <class T>
void gather_level_gradients(const GridLevels<T>& grid, const GridTable<T>& table, const T* points,
                            std::int64_t num_points, const T* grad, T* out) {
  const std::int64_t channels = table.channels, stride = output_width(grid, channels);
  with_channels<2, 4, 8, 16, 32>(channels, [&](auto constant) {
    constexpr int kChannels = decltype(constant)::value;
    parallel_for(num_points, kPointGrain, [&](std::int64_t begin, std::int64_t end) {
      for (std::int32_t level = 0; level < grid.count; ++level) {
        const T* g = grad + (grid.concatenated ? level * channels : 0);
        with_level(grid, level, points, [&](const auto& field) {
          if (level == 0) {
            gather_gradient_points<kChannels>(field, g, stride, table.rows, channels, begin, end, out);
          } else {
            gather_gradient_points<kChannels, true>(field, g, stride, table.rows, channels, begin, end, out);
          }
        });
      }
    });
  });
}

}  // namespace

template <>
std::int64_t grid_workspace_words<Cpu>(std::int64_t) {
  return 0;
}

template <class Device, class T>
void grid_interpolate(Device, const GridLevels<T>& grid, const GridTable<T>& table, const T* points,
                      std::int64_t num_points, T* out) {
  const std::int64_t channels = table.channels, stride = output_width(grid, channels);
  with_channels<2, 4, 8, 16, 32>(channels, [&](auto constant) {
    constexpr int kChannels = decltype(constant)::value;
    parallel_for(num_points, kPointGrain, [&](std::int64_t begin, std::int64_t end) {
      for (std::int32_t level = 0; level < grid.count; ++level) {
        with_level(grid, level, points, [&](const auto& field) {
          if (grid.concatenated || level == 0) {
            T* place = out + (grid.concatenated ? level * channels : 0);
            gather_points<kChannels>(field, table.rows, channels, begin, end, place, stride);
          } else {
            gather_points<kChannels, true>(field, table.rows, channels, begin, end, out, stride);
          }
        });
      }
    });
  });
}

template <class Device, class T>
void grid_interpolate_backward(Device, const GridLevels<T>& grid, const GridTable<T>& table, const T* points,
                               std::int64_t num_points, const T* grad, T* grad_table, T* grad_points, std::int64_t*) {
  if (grad_table) scatter_levels(grid, table, points, num_points, grad, grad_table);
  if (grad_points) gather_level_gradients(grid, table, points, num_points, grad, grad_points);
}

template <class Device, class T>
void row_gather(Device, const RowLists& lists, const T* table, const T* weights, T* out) {
  const RowLists l = lists;
  with_channels<2, 4, 8, 16, 32>(l.channels, [&](auto constant) {
    const std::int64_t count = decltype(constant)::value ? decltype(constant)::value : l.channels;
    parallel_for(l.num_lists, kPointGrain, [&](std::int64_t begin, std::int64_t end) {
      for (std::int64_t n = begin; n < end; ++n) {
        T* value = out + n * count;
        std::fill_n(value, count, T(0));
        for (std::int64_t i = n * l.length; i < (n + 1) * l.length; ++i) {
          if (!valid_row(l.rows[i], l.num_rows)) continue;
          const T* row = table + l.rows[i] * count;
#pragma omp simd
          for (std::int64_t c = 0; c < count; ++c) value[c] += weights[i] * row[c];
        }
      }
    });
  });
}

template <class Device, class T>
void row_scatter(Device, const RowLists& lists, const T* grad, const T* weights, T* out, std::int64_t*) {
  const RowLists l = lists;
  fill_zero(l.num_rows * l.channels, out);
  const std::int64_t width = slice_width<T>(l.channels, get_num_threads());
  parallel_for(width > 0 ? chunk_count(l.channels, width) : 0, 1, [&](std::int64_t begin, std::int64_t end) {
    const std::int64_t first = begin * width, count = std::min(end * width, l.channels) - first;
    with_channels<2, 4, 8, 16, 32>(count, [&](auto constant) {
      const std::int64_t columns = decltype(constant)::value ? decltype(constant)::value : count;
      for (std::int64_t n = 0; n < l.num_lists; ++n) {
        const T* g = grad + n * l.channels + first;
        for (std::int64_t i = n * l.length; i < (n + 1) * l.length; ++i) {
          if (!valid_row(l.rows[i], l.num_rows)) continue;
          T* sum = out + l.rows[i] * l.channels + first;
#pragma omp simd
          for (std::int64_t c = 0; c < columns; ++c) sum[c] += weights[i] * g[c];
        }
      }
    });
  });
}

template <class Device, class T>
void row_dot(Device, const RowLists& lists, const T* grad, const T* table, T* out) {
  const RowLists l = lists;
  with_channels<2, 4, 8, 16, 32>(l.channels, [&](auto constant) {
    const std::int64_t count = decltype(constant)::value ? decltype(constant)::value : l.channels;
    parallel_for(l.num_lists, kPointGrain, [&](std::int64_t begin, std::int64_t end) {
      for (std::int64_t n = begin; n < end; ++n) {
        const T* g = grad + n * count;
        for (std::int64_t i = n * l.length; i < (n + 1) * l.length; ++i) {
          T sum = 0;
          if (valid_row(l.rows[i], l.num_rows)) {
            const T* row = table + l.rows[i] * count;
#pragma omp simd reduction(+ : sum)
            for (std::int64_t c = 0; c < count; ++c) sum += g[c] * row[c];
          }
          out[i] = sum;
        }
      }
    });
  });
}

#define SPS_INSTANTIATE_GRIDS(T)                                                                                      \
  template void grid_interpolate<Cpu, T>(Cpu, const GridLevels<T>&, const GridTable<T>&, const T*, std::int64_t, T*); \
  template void grid_interpolate_backward<Cpu, T>(Cpu, const GridLevels<T>&, const GridTable<T>&, const T*,           \
                                                  std::int64_t, const T*, T*, T*, std::int64_t*);                     \
  template void row_gather<Cpu, T>(Cpu, const RowLists&, const T*, const T*, T*);                                     \
  template void row_scatter<Cpu, T>(Cpu, const RowLists&, const T*, const T*, T*, std::int64_t*);                     \
  template void row_dot<Cpu, T>(Cpu, const RowLists&, const T*, const T*, T*);
SPS_INSTANTIATE_GRIDS(float)
SPS_INSTANTIATE_GRIDS(double)

}  // namespace spslam
