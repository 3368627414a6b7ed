// Launches of interpolation in terms of three loops that each device implements: gather, gather_gradient, scatter.
#pragma once

#include "kernels/interpolation_stencils.h"
#include "spslam/interpolation.h"

namespace spslam {

// Each device specializes this, before it instantiates, with static functions
//   gather(device, field, table, channels, points, out): out[n] = sum of weight * row, 0 where there is no value;
//   gather_gradient(device, field, grad, table, channels, points, out): d (grad . value) / d coordinates, [N, kAxes];
//   scatter(device, field, grad, num_rows, channels, points, out, workspace): out[row] = sum of weight * grad;
//   fill_zero(device, count, out).
template <class Device>
struct InterpolationLoops;

template <class Device, class Field, class T>
void interpolate_backward(Device device, const Field& field, bool any_value, const T* grad, const T* table,
                          std::int64_t num_rows, std::int64_t channels, std::int64_t num_points, T* grad_table,
                          T* grad_coords, std::int64_t* workspace) {
  if (grad_table && any_value) {
    InterpolationLoops<Device>::scatter(device, field, grad, num_rows, channels, num_points, grad_table, workspace);
  } else if (grad_table) {
    InterpolationLoops<Device>::fill_zero(device, num_rows * channels, grad_table);
  }
  if (grad_coords && any_value) {
    InterpolationLoops<Device>::gather_gradient(device, field, grad, table, channels, num_points, grad_coords);
  } else if (grad_coords) {
    InterpolationLoops<Device>::fill_zero(device, num_points * Field::kAxes, grad_coords);
  }
}

template <class Device, class T>
void trilinear_interpolate(Device device, const T* embeddings, std::int64_t num_vertices, std::int64_t channels,
                           const std::int32_t* corner_ids, const T* local_coords, std::int64_t num_points, T* out) {
  InterpolationLoops<Device>::gather(device, TrilinearField<T>{corner_ids, local_coords, num_vertices}, embeddings,
                                     channels, num_points, out);
}

template <class Device, class T>
void trilinear_interpolate_backward(Device device, const T* grad, const T* embeddings, std::int64_t num_vertices,
                                    std::int64_t channels, const std::int32_t* corner_ids, const T* local_coords,
                                    std::int64_t num_points, T* grad_embeddings, T* grad_local_coords,
                                    std::int64_t* workspace) {
  const TrilinearField<T> field{corner_ids, local_coords, num_vertices};
  interpolate_backward(device, field, true, grad, embeddings, num_vertices, channels, num_points, grad_embeddings,
                       grad_local_coords, workspace);
}

template <class Device, class T>
void bilinear_interpolate(Device device, const T* texels, std::int64_t height, std::int64_t width,
                          std::int64_t channels, const T* uv, std::int64_t num_points, T* out) {
  InterpolationLoops<Device>::gather(device, BilinearField<T>{uv, height, width}, texels, channels, num_points, out);
}

template <class Device, class T>
void bilinear_interpolate_backward(Device device, const T* grad, const T* texels, std::int64_t height,
                                   std::int64_t width, std::int64_t channels, const T* uv, std::int64_t num_points,
                                   T* grad_texels, T* grad_uv, std::int64_t* workspace) {
  const BilinearField<T> field{uv, height, width};
  interpolate_backward(device, field, true, grad, texels, height * width, channels, num_points, grad_texels, grad_uv,
                       workspace);
}

inline bool covers_all_planes(const TriPlaneLayout& layout) {
  return !empty_plane(layout.planes[0]) && !empty_plane(layout.planes[1]) && !empty_plane(layout.planes[2]);
}

template <class Device, class T>
void tri_plane_interpolate(Device device, const T* texels, std::int64_t, std::int64_t channels, const T* points,
                           std::int64_t num_points, T inverse_cell_size, const TriPlaneLayout& layout, T* out) {
  if (!covers_all_planes(layout)) return InterpolationLoops<Device>::fill_zero(device, num_points * channels, out);
  InterpolationLoops<Device>::gather(device, TriPlaneField<T>{points, inverse_cell_size, layout}, texels, channels,
                                     num_points, out);
}

template <class Device, class T>
void tri_plane_interpolate_backward(Device device, const T* grad, const T* texels, std::int64_t num_rows,
                                    std::int64_t channels, const T* points, std::int64_t num_points,
                                    T inverse_cell_size, const TriPlaneLayout& layout, T* grad_texels, T* grad_points,
                                    std::int64_t* workspace) {
  const TriPlaneField<T> field{points, inverse_cell_size, layout};
  interpolate_backward(device, field, covers_all_planes(layout), grad, texels, num_rows, channels, num_points,
                       grad_texels, grad_points, workspace);
}

#define SPS_INSTANTIATE_INTERPOLATION(Device, T)                                                                       \
  template void trilinear_interpolate<Device, T>(Device, const T*, std::int64_t, std::int64_t, const std::int32_t*,    \
                                                 const T*, std::int64_t, T*);                                          \
  template void trilinear_interpolate_backward<Device, T>(Device, const T*, const T*, std::int64_t, std::int64_t,      \
                                                          const std::int32_t*, const T*, std::int64_t, T*, T*,         \
                                                          std::int64_t*);                                              \
  template void bilinear_interpolate<Device, T>(Device, const T*, std::int64_t, std::int64_t, std::int64_t, const T*,  \
                                                std::int64_t, T*);                                                     \
  template void bilinear_interpolate_backward<Device, T>(Device, const T*, const T*, std::int64_t, std::int64_t,       \
                                                         std::int64_t, const T*, std::int64_t, T*, T*, std::int64_t*); \
  template void tri_plane_interpolate<Device, T>(Device, const T*, std::int64_t, std::int64_t, const T*, std::int64_t, \
                                                 T, const TriPlaneLayout&, T*);                                        \
  template void tri_plane_interpolate_backward<Device, T>(Device, const T*, const T*, std::int64_t, std::int64_t,      \
                                                          const T*, std::int64_t, T, const TriPlaneLayout&, T*, T*,    \
                                                          std::int64_t*);

}  // namespace spslam
