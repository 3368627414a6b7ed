// Stencils: the rows of a table that a point is interpolated from, their weights, and the derivative by the point's
// coordinates. One interface for voxels, a plane and three planes, so that gathering and scattering exist once.
//
// The table may consist of kParts parts that share no row; load_part gives the rows and weights in one of them.
#pragma once

#include "kernels/interpolation.h"

namespace spslam {

template <class T>
SPS_INLINE Vec3<T> load_vec3(const T* p) {
  return {p[0], p[1], p[2]};
}

// Eight vertices of a sparse volume, by the corner ids of each point.
template <class T>
struct TrilinearField {
  static constexpr int kRows = 8, kAxes = 3, kParts = 1;

  const std::int32_t* corner_ids;  // [N, 8]
  const T* local_coords;           // [N, 3]
  std::int64_t num_vertices;

  struct Stencil {
    std::int64_t rows[kRows];
    T weights[kRows];
    Vec3<T> local;

    SPS_INLINE Vec3<T> gradient(const T (&values)[kRows]) const { return trilinear_gradient(local, values); }
  };

  using PartStencil = Stencil;

  // False where the point has no value.
  SPS_INLINE bool load(std::int64_t n, Stencil& stencil) const {
    const std::int32_t* ids = corner_ids + 8 * n;
    for (int k = 0; k < kRows; ++k) stencil.rows[k] = ids[k];
    stencil.local = load_vec3(local_coords + 3 * n);
    trilinear_weights(stencil.local, stencil.weights);
    return complete_cell(ids, num_vertices);
  }

  SPS_INLINE bool load_part(std::int64_t n, int, Stencil& stencil) const { return load(n, stencil); }
};

// Four texels of one image [H, W].
template <class T>
struct BilinearField {
  static constexpr int kRows = 4, kAxes = 2, kParts = 1;

  const T* uv;  // [N, 2]
  std::int64_t height, width;

  struct Stencil {
    std::int64_t rows[kRows];
    T weights[kRows];
    PlaneCell<T> cell;

    SPS_INLINE Vec3<T> gradient(const T (&values)[kRows]) const {
      const PlaneGradient<T> g = plane_gradient(cell, values);
      return {g.u, g.v, T(0)};
    }
  };

  using PartStencil = Stencil;

  SPS_INLINE bool load(std::int64_t n, Stencil& stencil) const {
    stencil.cell = plane_cell(axis_cell(uv[2 * n], 0, static_cast<std::int32_t>(width)),
                              axis_cell(uv[2 * n + 1], 0, static_cast<std::int32_t>(height)), 0, 1, width);
    for (int k = 0; k < kRows; ++k) {
      stencil.rows[k] = stencil.cell.rows[k];
      stencil.weights[k] = stencil.cell.weights[k];
    }
    return true;
  }

  SPS_INLINE bool load_part(std::int64_t n, int, Stencil& stencil) const { return load(n, stencil); }
};

// Four texels of each of the xy, xz and yz planes; their values add up (3).
template <class T>
struct TriPlaneField {
  static constexpr int kRows = 12, kAxes = 3, kParts = 3;

  const T* points;  // [N, 3] m
  T inverse_cell_size;
  TriPlaneLayout layout;

  struct Stencil {
    std::int64_t rows[kRows];
    T weights[kRows];
    PlaneCell<T> cells[3];
    T inverse_cell_size;

    SPS_INLINE Vec3<T> gradient(const T (&values)[kRows]) const {
      Vec3<T> sum{0, 0, 0};
      for (int plane = 0; plane < 3; ++plane) {
        const T corners[4] = {values[4 * plane], values[4 * plane + 1], values[4 * plane + 2], values[4 * plane + 3]};
        add_plane_gradient(plane_gradient(cells[plane], corners), inverse_cell_size, plane, sum);
      }
      return sum;
    }
  };

  using PartStencil = PlaneCell<T>;

  SPS_INLINE bool load(std::int64_t n, Stencil& stencil) const {
    const Vec3<T> point = load_vec3(points + 3 * n);
    stencil.inverse_cell_size = inverse_cell_size;
    for (int plane = 0; plane < 3; ++plane) {
      stencil.cells[plane] = tri_plane_cell(point, inverse_cell_size, layout.planes[plane], plane);
      for (int k = 0; k < 4; ++k) {
        stencil.rows[4 * plane + k] = stencil.cells[plane].rows[k];
        stencil.weights[4 * plane + k] = stencil.cells[plane].weights[k];
      }
    }
    return true;
  }

  SPS_INLINE bool load_part(std::int64_t n, int plane, PlaneCell<T>& cell) const {
    cell = tri_plane_cell(load_vec3(points + 3 * n), inverse_cell_size, layout.planes[plane], plane);
    return true;
  }
};

}  // namespace spslam
