// Interpolation in sparse volumes, images and tri-planes, with gradients to the table and to the coordinates.
//
// Backward functions overwrite their outputs; a null output is not computed. They sum in a fixed order (Cpu) or in
// fixed-point integers (Cuda): the same input gives the same bits, whatever the number of threads.
#pragma once

#include <cstdint>

#include "core/device.h"
#include "spslam/types/tri_plane_layout.h"

namespace spslam {

// 64-bit words of scratch memory that a backward function needs for the gradient of a table.
template <class Device>
std::int64_t scatter_workspace_words(std::int64_t table_size);

// embeddings [num_vertices, channels], corner_ids [N, 8], local_coords [N, 3] in [0, 1], out [N, channels]. A point
// with an id outside [0, num_vertices) has the value 0.
template <class Device, class T>
void trilinear_interpolate(Device device, const T* embeddings, std::int64_t num_vertices, std::int64_t channels,
                           const std::int32_t* corner_ids, const T* local_coords, std::int64_t num_points, T* out);

template <class Device, class T>
void trilinear_interpolate_backward(Device device, const T* grad, const T* embeddings, std::int64_t num_vertices,
                                    std::int64_t channels, const std::int32_t* corner_ids, const T* local_coords,
                                    std::int64_t num_points, T* grad_embeddings, T* grad_local_coords,
                                    std::int64_t* workspace);

// texels [height, width, channels], uv [N, 2] in texels (u along the width), clamped, out [N, channels].
template <class Device, class T>
void bilinear_interpolate(Device device, const T* texels, std::int64_t height, std::int64_t width,
                          std::int64_t channels, const T* uv, std::int64_t num_points, T* out);

template <class Device, class T>
void bilinear_interpolate_backward(Device device, const T* grad, const T* texels, std::int64_t height,
                                   std::int64_t width, std::int64_t channels, const T* uv, std::int64_t num_points,
                                   T* grad_texels, T* grad_uv, std::int64_t* workspace);

// texels [num_rows, channels], points [N, 3] in meters, clamped to each plane, out [N, channels]. If a plane is empty
// the value is 0.
template <class Device, class T>
void tri_plane_interpolate(Device device, const T* texels, std::int64_t num_rows, std::int64_t channels,
                           const T* points, std::int64_t num_points, T inverse_cell_size, const TriPlaneLayout& layout,
                           T* out);

template <class Device, class T>
void tri_plane_interpolate_backward(Device device, const T* grad, const T* texels, std::int64_t num_rows,
                                    std::int64_t channels, const T* points, std::int64_t num_points,
                                    T inverse_cell_size, const TriPlaneLayout& layout, T* grad_texels, T* grad_points,
                                    std::int64_t* workspace);

}  // namespace spslam
