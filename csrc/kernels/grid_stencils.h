// Stencils of one level of a grid, in the interface of interpolation_stencils.h.
#pragma once

#include "kernels/interpolation_stencils.h"
#include "spslam/grid_interpolation.h"

namespace spslam {

template <class T>
SPS_INLINE AxisCell<T> level_axis(const GridLevel<T>& level, const T* point, int axis) {
  return axis_cell(point[axis] * level.scale[axis] + level.shift[axis], 0, level.size[axis]);
}

// Twelve texels: four of each of the xy, xz and yz planes of a level.
template <class T>
struct PlaneLevelField {
  static constexpr int kRows = 12, kAxes = 3, kParts = 3;

  const T* points;  // [N, 3]
  GridLevel<T> level;

  struct Stencil {
    std::int64_t rows[kRows];
    T weights[kRows];
    PlaneCell<T> cells[3];
    T scale[3];

    SPS_INLINE Vec3<T> gradient(const T (&values)[kRows]) const {
      T sum[3] = {0, 0, 0};
      for (int plane = 0; plane < 3; ++plane) {
        const T corners[4] = {values[4 * plane], values[4 * plane + 1], values[4 * plane + 2], values[4 * plane + 3]};
        const PlaneGradient<T> g = plane_gradient(cells[plane], corners);
        sum[plane == 2 ? 1 : 0] += g.u;
        sum[plane == 0 ? 1 : 2] += g.v;
      }
      return {scale[0] * sum[0], scale[1] * sum[1], scale[2] * sum[2]};
    }
  };

  using PartStencil = PlaneCell<T>;

  SPS_INLINE bool load(std::int64_t n, Stencil& stencil) const {
    for (int plane = 0; plane < 3; ++plane) {
      load_part(n, plane, stencil.cells[plane]);
      stencil.scale[plane] = level.scale[plane];
      for (int k = 0; k < 4; ++k) {
        stencil.rows[4 * plane + k] = stencil.cells[plane].rows[k];
        stencil.weights[4 * plane + k] = stencil.cells[plane].weights[k];
      }
    }
    return true;
  }

  SPS_INLINE bool load_part(std::int64_t n, int plane, PlaneCell<T>& cell) const {
    const int u = plane == 2 ? 1 : 0, v = plane == 0 ? 1 : 2;
    cell = plane_cell(level_axis(level, points + 3 * n, u), level_axis(level, points + 3 * n, v), level.offset[plane],
                      level.size[v], 1);
    return true;
  }
};

// The row of a grid's vertex in a hashed level: the spatial hash of Mueller et al., "Instant Neural Graphics
// Primitives", equation 4.
SPS_INLINE std::int64_t hashed_row(std::int32_t x, std::int32_t y, std::int32_t z, std::int32_t rows) {
  const std::uint32_t h = static_cast<std::uint32_t>(x) ^ (static_cast<std::uint32_t>(y) * 2654435761u) ^
                          (static_cast<std::uint32_t>(z) * 805459861u);
  return h & (static_cast<std::uint32_t>(rows) - 1u);
}

// Whether a number in a list names a row of a table.
SPS_INLINE bool valid_row(std::int32_t row, std::int64_t num_rows) {
  return row >= 0 && row < num_rows;
}

// Eight vertices of a level that is a volume.
template <class T>
struct VolumeLevelField {
  static constexpr int kRows = 8, kAxes = 3, kParts = 1;

  const T* points;  // [N, 3]
  GridLevel<T> level;

  struct Stencil {
    std::int64_t rows[kRows];
    T weights[kRows];
    Vec3<T> local, slope;  // slope: d local / d point

    SPS_INLINE Vec3<T> gradient(const T (&values)[kRows]) const {
      const Vec3<T> g = trilinear_gradient(local, values);
      return {slope.x * g.x, slope.y * g.y, slope.z * g.z};
    }
  };

  using PartStencil = Stencil;

  SPS_INLINE bool load(std::int64_t n, Stencil& stencil) const {
    const T* p = points + 3 * n;
    const AxisCell<T> x = level_axis(level, p, 0), y = level_axis(level, p, 1), z = level_axis(level, p, 2);
    for (int k = 0; k < kRows; ++k) {
      const std::int32_t ix = k & 1 ? x.upper : x.lower, iy = k & 2 ? y.upper : y.lower, iz = k & 4 ? z.upper : z.lower;
      const std::int64_t row = level.hash_rows
                                   ? hashed_row(ix, iy, iz, level.hash_rows)
                                   : (static_cast<std::int64_t>(ix) * level.size[1] + iy) * level.size[2] + iz;
      stencil.rows[k] = level.offset[0] + row;
    }
    stencil.local = {x.fraction, y.fraction, z.fraction};
    stencil.slope = {x.slope * level.scale[0], y.slope * level.scale[1], z.slope * level.scale[2]};
    trilinear_weights(stencil.local, stencil.weights);
    return true;
  }

  SPS_INLINE bool load_part(std::int64_t n, int, Stencil& stencil) const { return load(n, stencil); }
};

}  // namespace spslam
