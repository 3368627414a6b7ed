#include <cstring>
#include <type_traits>

#include "core/ordered_scatter.h"
#include "core/parallel.h"
#include "kernels/interpolation_launch.h"

namespace spslam {
namespace {

constexpr std::int64_t kPointGrain = 512;

// Calls f with the number of channels as a constant where it is a common one, else as 0.
template <class F>
void with_channels(std::int64_t channels, const F& f) {
  switch (channels) {
    case 8:
      return f(std::integral_constant<int, 8>{});
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

  template <class Field, class T>
  static void scatter(Cpu device, const Field& field, const T* grad, std::int64_t num_rows, std::int64_t channels,
                      std::int64_t num_points, T* out, std::int64_t*) {
    fill_zero(device, num_rows * channels, out);
    with_channels(channels, [&](auto constant) {
      const std::int64_t count = decltype(constant)::value ? decltype(constant)::value : channels;
      ordered_scatter<typename Field::Stencil, Field::kRows, T>(
          num_points, num_rows,
          [&](std::int64_t n, typename Field::Stencil& stencil) { return field.load(n, stencil); },
          [=](std::int64_t n, std::int64_t row, T weight) {
            const T* g = grad + n * count;
            T* sum = out + row * count;
#pragma omp simd
            for (std::int64_t c = 0; c < count; ++c) sum[c] += weight * g[c];
          });
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
