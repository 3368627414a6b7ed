// Loops over points that are interpolated between rows of a table, for any stencil (kernels/interpolation_stencils.h).
#pragma once

#include <algorithm>
#include <cstdint>
#include <cstring>

#include "core/parallel.h"
#include "cpu/channels.h"
#include "kernels/interpolation_stencils.h"

namespace spslam {

constexpr std::int64_t kPointGrain = 512;

// Values of points [begin, end) into rows of `out` that are `stride` apart; with kAdd they are added to them.
template <int kChannels, bool kAdd = false, class Field, class T>
inline void gather_points(const Field& field, const T* table, std::int64_t channels, std::int64_t begin,
                          std::int64_t end, T* out, std::int64_t stride) {
  const std::int64_t count = kChannels ? kChannels : channels;
  typename Field::Stencil stencil;
  for (std::int64_t n = begin; n < end; ++n) {
    T* value = out + n * stride;
    if (!field.load(n, stencil)) {
      if (kAdd) continue;
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
      value[c] = kAdd ? value[c] + sum : sum;
    }
  }
}

// Gradients of the coordinates of points [begin, end), from rows of `grad` that are `stride` apart.
template <int kChannels, bool kAdd = false, class Field, class T>
inline void gather_gradient_points(const Field& field, const T* grad, std::int64_t stride, const T* table,
                                   std::int64_t channels, std::int64_t begin, std::int64_t end, T* out) {
  const std::int64_t count = kChannels ? kChannels : channels;
  typename Field::Stencil stencil;
  for (std::int64_t n = begin; n < end; ++n) {
    T x = 0, y = 0, z = 0;
    if (field.load(n, stencil)) {
      const T* g = grad + n * stride;
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
    if (kAdd) {
      for (int axis = 0; axis < Field::kAxes; ++axis) out[n * Field::kAxes + axis] += coords[axis];
    } else {
      std::memcpy(out + n * Field::kAxes, coords, Field::kAxes * sizeof(T));
    }
  }
}

// Channels a thread takes so that `slices` share a row: whole cache lines, as two threads must not write to one.
template <class T>
inline std::int64_t slice_width(std::int64_t channels, std::int64_t slices) {
  constexpr std::int64_t kLine = 64 / static_cast<std::int64_t>(sizeof(T));
  return std::min(channels, chunk_count(chunk_count(channels, slices), kLine) * kLine);
}

// Sums `width` neighboring channels of one part of the table, from rows of `grad` that are `stride` apart.
template <int kWidth, class Field, class T>
inline void scatter_part(const Field& field, int part, const T* grad, std::int64_t stride, std::int64_t channels,
                         std::int64_t width, std::int64_t num_points, T* out) {
  const std::int64_t count = kWidth ? kWidth : width;
  constexpr int kPartRows = Field::kRows / Field::kParts;
  typename Field::PartStencil stencil;
  for (std::int64_t n = 0; n < num_points; ++n) {
    if (!field.load_part(n, part, stencil)) continue;
    const T* g = grad + n * stride;
    for (int k = 0; k < kPartRows; ++k) {
      T* sum = out + stencil.rows[k] * channels;
#pragma omp simd
      for (std::int64_t c = 0; c < count; ++c) sum[c] += stencil.weights[k] * g[c];
    }
  }
}

}  // namespace spslam
