#include "launch/interpolation.h"

#include <algorithm>
#include <cstring>
#include <type_traits>

#include "core/parallel.h"

namespace spslam {
namespace {

constexpr std::int64_t kPointGrain = 512;

// Calls f with the number of channels as a constant where it is a common one, else as 0.
template <class F>
void with_channels(std::int64_t channels, const F& f) {
  switch (channels) {
    case 8:
      return f(std::integral_constant<int, 8>{});
    case 16:
      return f(std::integral_constant<int, 16>{});
    case 32:
      return f(std::integral_constant<int, 32>{});
    default:
      return f(std::integral_constant<int, 0>{});
  }
}

template <int kChannels, class Field, class T>
void gather_points(const Field& field, const T* table, std::int64_t channels, std::int64_t begin, std::int64_t end,
                   T* out) {
  const std::int64_t count = kChannels ? kChannels : channels;
  typename Field::Stencil stencil;
  for (std::int64_t n = begin; n < end; ++n) {
    T* value = out + n * count;
    if (!field.load(n, stencil)) {
      std::memset(value, 0, static_cast<std::size_t>(count) * sizeof(T));
      continue;
    }
    const T* rows[Field::kRows];
    for (int k = 0; k < Field::kRows; ++k) rows[k] = table + stencil.rows[k] * count;
#pragma omp simd
    for (std::int64_t c = 0; c < count; ++c) {
      T sum = 0;
#pragma GCC unroll 12
      for (int k = 0; k < Field::kRows; ++k) sum += stencil.weights[k] * rows[k][c];
      value[c] = sum;
    }
  }
}

template <int kChannels, class Field, class T>
void gather_gradient_points(const Field& field, const T* grad, const T* table, std::int64_t channels,
                            std::int64_t begin, std::int64_t end, T* out) {
  const std::int64_t count = kChannels ? kChannels : channels;
  typename Field::Stencil stencil;
  for (std::int64_t n = begin; n < end; ++n) {
    T x = 0, y = 0, z = 0;
    if (field.load(n, stencil)) {
      const T* g = grad + n * count;
      const T* rows[Field::kRows];
      for (int k = 0; k < Field::kRows; ++k) rows[k] = table + stencil.rows[k] * count;
#pragma omp simd reduction(+ : x, y, z)
      for (std::int64_t c = 0; c < count; ++c) {
        T values[Field::kRows];
#pragma GCC unroll 12
        for (int k = 0; k < Field::kRows; ++k) values[k] = rows[k][c];
        const Vec3<T> gradient = stencil.gradient(values);
        x += g[c] * gradient.x;
        y += g[c] * gradient.y;
        z += g[c] * gradient.z;
      }
    }
    const T coords[3] = {x, y, z};
    std::memcpy(out + n * Field::kAxes, coords, Field::kAxes * sizeof(T));
  }
}

// Channels a thread takes so that `slices` share a row: whole cache lines, as two threads must not write to one.
template <class T>
std::int64_t slice_width(std::int64_t channels, std::int64_t slices) {
  constexpr std::int64_t kLine = 64 / static_cast<std::int64_t>(sizeof(T));
  return std::min(channels, chunk_count(chunk_count(channels, slices), kLine) * kLine);
}

// Sums `width` neighboring channels of one part of the table.
template <int kWidth, class Field, class T>
void scatter_part(const Field& field, int part, const T* grad, std::int64_t channels, std::int64_t width,
                  std::int64_t num_points, T* out) {
  const std::int64_t count = kWidth ? kWidth : width;
  constexpr int kPartRows = Field::kRows / Field::kParts;
  typename Field::PartStencil stencil;
  for (std::int64_t n = 0; n < num_points; ++n) {
    if (!field.load_part(n, part, stencil)) continue;
    const T* g = grad + n * channels;
    for (int k = 0; k < kPartRows; ++k) {
      T* sum = out + stencil.rows[k] * channels;
#pragma omp simd
      for (std::int64_t c = 0; c < count; ++c) sum[c] += stencil.weights[k] * g[c];
    }
  }
}

}  // namespace

template <>
struct InterpolationLoops<Cpu> {
  template <class T>
  static void fill_zero(Cpu, std::int64_t count, T* out) {
    constexpr std::int64_t kGrain = 1 << 16;
    parallel_for(count, kGrain, [=](std::int64_t begin, std::int64_t end) {
      std::memset(out + begin, 0, static_cast<std::size_t>(end - begin) * sizeof(T));
    });
  }

  template <class Field, class T>
  static void gather(Cpu, const Field& field, const T* table, std::int64_t channels, std::int64_t num_points, T* out) {
    with_channels(channels, [&](auto constant) {
      parallel_for(num_points, kPointGrain, [&](std::int64_t begin, std::int64_t end) {
        gather_points<decltype(constant)::value>(field, table, channels, begin, end, out);
      });
    });
  }

  template <class Field, class T>
  static void gather_gradient(Cpu, const Field& field, const T* grad, const T* table, std::int64_t channels,
                              std::int64_t num_points, T* out) {
    with_channels(channels, [&](auto constant) {
      parallel_for(num_points, kPointGrain, [&](std::int64_t begin, std::int64_t end) {
        gather_gradient_points<decltype(constant)::value>(field, grad, table, channels, begin, end, out);
      });
    });
  }

  // A row is summed in the order of the points, by one thread: threads share the work by parts of the table and by
  // cache lines of its rows. Sharing out the rows themselves was measured and is slower with any number of threads:
  // neighboring points share rows, which are still in the cache when points are taken in order.
  template <class Field, class T>
  static void scatter(Cpu device, const Field& field, const T* grad, std::int64_t num_rows, std::int64_t channels,
                      std::int64_t num_points, T* out, std::int64_t*) {
    fill_zero(device, num_rows * channels, out);
    const std::int64_t width = slice_width<T>(channels, (get_num_threads() + Field::kParts - 1) / Field::kParts);
    const std::int64_t slices = width > 0 ? chunk_count(channels, width) : 0;
    parallel_for(Field::kParts * slices, 1, [&](std::int64_t begin, std::int64_t end) {
      for (std::int64_t task = begin; task < end; ++task) {
        const std::int64_t first = task % slices * width;
        const std::int64_t count = std::min(width, channels - first);
        with_channels(count, [&](auto constant) {
          scatter_part<decltype(constant)::value>(field, static_cast<int>(task / slices), grad + first, channels, count,
                                                  num_points, out + first);
        });
      }
    });
  }
};

template <>
std::int64_t scatter_workspace_words<Cpu>(std::int64_t) {
  return 0;
}

SPS_INSTANTIATE_INTERPOLATION(Cpu, float)
SPS_INSTANTIATE_INTERPOLATION(Cpu, double)
}  // namespace spslam
