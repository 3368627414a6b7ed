// Interpolation in grids of several resolutions: tri-planes, dense grids and hashed ones, all levels at once, with
// gradients for the table and the points.
#pragma once

#include <cstdint>

#include "core/device.h"

namespace spslam {

enum class GridKind : std::int32_t { kTriPlanes = 0, kVolume = 1 };

// One level. A point p is at p * scale + shift in texels, clamped to [0, size - 1] along each axis.
template <class T>
struct GridLevel {
  // Rows of the table where its planes xy, xz and yz begin, texel (iu, iv) at iu * size_v + iv; of a volume the first
  // alone, texel (ix, iy, iz) at (ix * size_y + iy) * size_z + iz.
  std::int64_t offset[3];
  std::int32_t size[3];
  std::int32_t hash_rows;  // rows of a hashed volume, a power of two; 0: not hashed
  T scale[3], shift[3];
};

constexpr int kMaxGridLevels = 16;

template <class T>
struct GridLevels {
  GridLevel<T> levels[kMaxGridLevels];
  std::int32_t count;
  GridKind kind;
  bool concatenated;  // whether a level has channels of its own in the output, or they add up
};

template <class T>
struct GridTable {
  const T* rows;
  std::int64_t num_rows, channels;
};

// 64-bit words of scratch memory that the backward function needs for the gradient of a table of that size.
template <class Device>
std::int64_t grid_workspace_words(std::int64_t table_size);

// points [N, 3], out [N, channels or count * channels].
template <class Device, class T>
void grid_interpolate(Device device, const GridLevels<T>& grid, const GridTable<T>& table, const T* points,
                      std::int64_t num_points, T* out);

// grad_table and grad_points may be null.
template <class Device, class T>
void grid_interpolate_backward(Device device, const GridLevels<T>& grid, const GridTable<T>& table, const T* points,
                               std::int64_t num_points, const T* grad, T* grad_table, T* grad_points,
                               std::int64_t* workspace);

// Sums of rows of a table by lists of row numbers and weights [N, K], and their two gradients: what derivatives of
// interpolation of any order are composed of. A number outside of [0, num_rows) counts as a row of zeros.
struct RowLists {
  const std::int32_t* rows;
  std::int64_t num_lists, length, num_rows, channels;
};

// out [N, channels] = sum_k weights[n, k] table[rows[n, k]]
template <class Device, class T>
void row_gather(Device device, const RowLists& lists, const T* table, const T* weights, T* out);

// out [num_rows, channels] = the sum of weights[n, k] grad[n] over all (n, k) with that row
template <class Device, class T>
void row_scatter(Device device, const RowLists& lists, const T* grad, const T* weights, T* out,
                 std::int64_t* workspace);

// out [N, K] = grad[n] . table[rows[n, k]]
template <class Device, class T>
void row_dot(Device device, const RowLists& lists, const T* grad, const T* table, T* out);

}  // namespace spslam
