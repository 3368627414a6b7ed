// Trilinear, bilinear and tri-plane interpolation: cells, weights and their derivatives (equations 2 and 3).
#pragma once

#include <cmath>
#include <cstdint>

#include "core/macros.h"
#include "core/vec.h"
#include "spslam/types/tri_plane_layout.h"

namespace spslam {

// ---- voxels. Corner k of a cell lies at offset (k & 1, k >> 1 & 1, k >> 2 & 1) from its lowest corner.

template <class T>
struct VoxelCell {
  std::int32_t x, y, z;  // lowest corner
  Vec3<T> local;         // position inside, in [0, 1)
};

// Floor as an integer. Far outside the range of voxel coordinates, and for NaN, it is some integer outside that range.
template <class T>
SPS_INLINE std::int32_t floor_to_int(T u) {
  constexpr T kFar = T(1 << 30);
  const T f = std::floor(u);
  return static_cast<std::int32_t>(f > -kFar ? (f < kFar ? f : kFar) : -kFar);
}

// The cell of a point. inverse_size = 1 / voxel size, rounded once to T.
template <class T>
SPS_INLINE VoxelCell<T> voxel_cell(const Vec3<T>& point, T inverse_size) {
  const Vec3<T> u = inverse_size * point;
  return {floor_to_int(u.x),
          floor_to_int(u.y),
          floor_to_int(u.z),
          {u.x - std::floor(u.x), u.y - std::floor(u.y), u.z - std::floor(u.z)}};
}

template <class T>
SPS_INLINE T trilinear_weight(const Vec3<T>& local, int k) {
  return (k & 1 ? local.x : 1 - local.x) * (k & 2 ? local.y : 1 - local.y) * (k & 4 ? local.z : 1 - local.z);
}

template <class T>
SPS_INLINE void trilinear_weights(const Vec3<T>& local, T (&weights)[8]) {
  for (int k = 0; k < 8; ++k) weights[k] = trilinear_weight(local, k);
}

template <class T>
SPS_INLINE T lerp(T a, T b, T t) {
  return a + t * (b - a);
}

// d(sum_k weight[k] * values[k]) / d local, for one value per corner.
template <class T>
SPS_INLINE Vec3<T> trilinear_gradient(const Vec3<T>& local, const T (&values)[8]) {
  const T* v = values;
  const T dx = lerp(lerp(v[1] - v[0], v[3] - v[2], local.y), lerp(v[5] - v[4], v[7] - v[6], local.y), local.z);
  const T y0 = lerp(v[2] - v[0], v[3] - v[1], local.x), y1 = lerp(v[6] - v[4], v[7] - v[5], local.x);
  const T z0 = lerp(v[4] - v[0], v[5] - v[1], local.x), z1 = lerp(v[6] - v[2], v[7] - v[3], local.x);
  return {dx, lerp(y0, y1, local.z), lerp(z0, z1, local.y)};
}

// A cell is complete if all of its corners exist: only then does it hold a value.
SPS_INLINE bool complete_cell(const std::int32_t* corner_ids, std::int64_t num_vertices) {
  bool complete = true;
  for (int k = 0; k < 8; ++k) complete &= corner_ids[k] >= 0 && corner_ids[k] < num_vertices;
  return complete;
}

// ---- planes. Corner k of a plane cell lies at offset k & 1 along u and k >> 1 along v.

template <class T>
struct AxisCell {
  std::int32_t lower, upper;  // texels, counted from the start of the axis
  T fraction;                 // between them
  T slope;                    // d fraction / d position: 1, or 0 where the position was clamped
};

// The cell of a position in texel units on an axis of `size` >= 1 texels starting at `origin`, clamped to its ends.
template <class T>
SPS_INLINE AxisCell<T> axis_cell(T position, std::int32_t origin, std::int32_t size) {
  const T u = position - static_cast<T>(origin), last = static_cast<T>(size - 1);
  const T clamped = u > 0 ? (u < last ? u : last) : T(0);
  const std::int32_t floored = static_cast<std::int32_t>(clamped), highest = size > 1 ? size - 2 : 0;
  const std::int32_t lower = floored < highest ? floored : highest;
  const T fraction = clamped - static_cast<T>(lower);
  return {lower, lower + (size > 1 ? 1 : 0), u == u ? fraction : u, u > 0 && u < last ? T(1) : T(0)};
}

template <class T>
SPS_INLINE void bilinear_weights(T u, T v, T (&weights)[4]) {
  weights[0] = (1 - u) * (1 - v);
  weights[1] = u * (1 - v);
  weights[2] = (1 - u) * v;
  weights[3] = u * v;
}

template <class T>
struct PlaneCell {
  std::int64_t rows[4];  // of the texel table
  T weights[4];
  T u, v;              // fractions
  T slope_u, slope_v;  // d fraction / d position in texel units
};

template <class T>
SPS_INLINE PlaneCell<T> plane_cell(const AxisCell<T>& u, const AxisCell<T>& v, std::int64_t offset,
                                   std::int64_t stride_u, std::int64_t stride_v) {
  const std::int64_t u0 = offset + u.lower * stride_u, u1 = offset + u.upper * stride_u;
  const std::int64_t v0 = v.lower * stride_v, v1 = v.upper * stride_v;
  PlaneCell<T> cell{{u0 + v0, u1 + v0, u0 + v1, u1 + v1}, {}, u.fraction, v.fraction, u.slope, v.slope};
  bilinear_weights(cell.u, cell.v, cell.weights);
  return cell;
}

template <class T>
struct PlaneGradient {
  T u, v;
};

// d(sum_k weight[k] * values[k]) / d position in texel units, for one value per corner.
template <class T>
SPS_INLINE PlaneGradient<T> plane_gradient(const PlaneCell<T>& cell, const T (&values)[4]) {
  return {cell.slope_u * lerp(values[1] - values[0], values[3] - values[2], cell.v),
          cell.slope_v * lerp(values[2] - values[0], values[3] - values[1], cell.u)};
}

template <class T>
SPS_INLINE T plane_u(const Vec3<T>& point, int plane) {
  return plane == 2 ? point.y : point.x;
}
template <class T>
SPS_INLINE T plane_v(const Vec3<T>& point, int plane) {
  return plane == 0 ? point.y : point.z;
}

SPS_INLINE bool empty_plane(const PlaneLayout& layout) {
  return layout.size_u == 0 || layout.size_v == 0;
}

// The cell of a point on one plane, which must not be empty. inverse_size = 1 / cell size, rounded once to T.
template <class T>
SPS_INLINE PlaneCell<T> tri_plane_cell(const Vec3<T>& point, T inverse_size, const PlaneLayout& layout, int plane) {
  return plane_cell(axis_cell(plane_u(point, plane) * inverse_size, layout.origin_u, layout.size_u),
                    axis_cell(plane_v(point, plane) * inverse_size, layout.origin_v, layout.size_v), layout.offset,
                    layout.size_v, 1);
}

// Adds a plane's gradient (texel units) to the gradient of the point (meters).
template <class T>
SPS_INLINE void add_plane_gradient(const PlaneGradient<T>& gradient, T inverse_size, int plane, Vec3<T>& point) {
  (plane == 2 ? point.y : point.x) += inverse_size * gradient.u;
  (plane == 0 ? point.y : point.z) += inverse_size * gradient.v;
}

}  // namespace spslam
