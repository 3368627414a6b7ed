"""Interpolation in sparse volumes, images and tri-planes, differentiable with respect to values and coordinates.

All ops support float32 and float64, and non-contiguous and empty input. The same input gives the same bits: gradients
of a table are summed in the order of the points on the CPU, for any number of threads, and in 64-bit fixed point on
CUDA. Derivatives of second and higher order are sums over rows as well, see `_stencils`. On the CPU, the gradient of a
table with rows shorter than a cache line, such as 8 float32 embeddings, is summed by a single thread; all other work is
parallel. Points may have more than one leading axis, [..., 3] in place of [N, 3]. Tables of float16 and bfloat16 are
read as float32, in which the op then computes and returns; their gradients come in their own dtype.
"""

from collections.abc import Sequence

import torch

from spslam.ops import _library  # noqa: F401
from spslam.ops._autograd import register_gradient
from spslam.ops._checks import INTEGERS, TABLES, check, check_tensor, flat_rows, rows_shape, unflat_rows, wide
from spslam.ops._dispatch import call
from spslam.ops._public import public_op
from spslam.ops._stencils import (
    PLANE_AXES,
    Stencil,
    axis_cell,
    corner_weights,
    plane_stencil,
    stencil_gradients,
    tri_plane_stencil,
)
from spslam.ops._vmap import register_each_vmap, register_rows_vmap

_FARTHEST_TEXEL = 2**30
_ROW_NUMBERS = 2**31
# Of [1, H, W], [3, H, W] and [4, H, W] taken for [H, W, C]: no field has so few rows of so many features.
_PHOTO_CHANNELS, _FEWEST_COLUMNS, _MOST_FEATURES = (1, 3, 4), 16, 128


@public_op()
def trilinear_interpolate(
    embeddings: torch.Tensor, corner_ids: torch.Tensor, local_coords: torch.Tensor
) -> torch.Tensor:
    """Features of points inside the cells of a sparse volume (TriLerp of equation 2).

    Args:
        embeddings: [V, C] float32 or float64, or float16 or bfloat16: one feature vector per voxel vertex.
        corner_ids: int32 or int64 [N, 8], rows of `embeddings` at the corners of each point's cell; corner k lies at
            offset (k & 1, k >> 1 & 1, k >> 2 & 1) from the lowest one. A point with an id outside [0, V), such as the
            -1 of a missing vertex, gets the value 0 and no gradient.
        local_coords: [N, 3] of the dtype of `embeddings`, position inside the cell in [0, 1], as x, y, z. A coordinate
            that is not finite gives NaN for its point.

    Returns:
        [N, C]. Differentiable with respect to `embeddings` and `local_coords`. N = 0 gives an empty tensor.

    Raises:
        TypeError: a dtype is wrong.
        ValueError: a shape or device does not fit.

    Example:
        >>> embeddings = torch.arange(8.0)[:, None]
        >>> corners = torch.arange(8, dtype=torch.int32)[None]
        >>> trilinear_interpolate(embeddings, corners, torch.tensor([[0.5, 0.25, 0.0]]))
        tensor([[1.]])
    """
    name = "trilinear_interpolate"
    check_tensor(name, "embeddings", embeddings, ("V", "C"), TABLES)
    embeddings = wide(embeddings)
    check_tensor(name, "corner_ids", corner_ids, rows_shape(corner_ids, 8), INTEGERS, like=embeddings)
    leading = corner_ids.shape[:-1]
    check_tensor(name, "local_coords", local_coords, (*leading, 3), embeddings.dtype, like=embeddings)
    rows = as_row_numbers(flat_rows(corner_ids))
    return unflat_rows(call(name, embeddings, rows, flat_rows(local_coords)), leading)


@public_op()
def bilinear_interpolate(texels: torch.Tensor, uv: torch.Tensor) -> torch.Tensor:
    """Bilinear interpolation in an image or plane.

    Args:
        texels: [H, W, C] float32 or float64, or float16 or bfloat16; H and W at least 1 unless N is 0. What is plainly
            an image [C, H, W] is refused: H of 1, 3 or 4 with at least 16 columns and 128 channels.
        uv: [N, 2] of the same dtype, positions in texels, u along W and v along H: (0, 0) is the center of the first
            texel, (W - 1, H - 1) that of the last. Positions outside, including infinity, are clamped to the border,
            with zero gradient; NaN gives NaN for its point.

    Returns:
        [N, C]. Differentiable with respect to `texels` and `uv`. N = 0 gives an empty tensor.

    Raises:
        TypeError: a dtype is wrong.
        ValueError: a shape or device does not fit.

    Example:
        >>> bilinear_interpolate(torch.tensor([[[0.0], [1.0]], [[2.0], [3.0]]]), torch.tensor([[0.5, 1.0]]))
        tensor([[2.5000]])
    """
    name = "bilinear_interpolate"
    check_tensor(name, "texels", texels, ("H", "W", "C"), TABLES)
    check(not _is_plainly_chw(texels), name, "texels", "be [H, W, C]: permute(1, 2, 0) an image", list(texels.shape))
    texels = wide(texels)
    check_tensor(name, "uv", uv, rows_shape(uv, 2), texels.dtype, like=texels)
    has_texels = texels.shape[0] > 0 and texels.shape[1] > 0
    check(has_texels or uv.numel() == 0, name, "texels", "have at least one texel", list(texels.shape))
    return unflat_rows(call(name, texels, flat_rows(uv)), uv.shape[:-1])


@public_op()
def tri_plane_interpolate(
    texels: torch.Tensor, points: torch.Tensor, cell_size: float, layout: Sequence[int]
) -> torch.Tensor:
    """Features of points as the sum of three axis-aligned planes (equation 3).

    Args:
        texels: [P, C] float32 or float64, or float16 or bfloat16: the texels of all planes as rows of one table.
        points: [N, 3] of the same dtype, meters. NaN gives NaN for its point.
        cell_size: distance between texels, meters; texel (iu, iv) is at (iu, iv) * cell_size.
        layout: 15 integers, (offset, origin_u, origin_v, size_u, size_v) for each of the planes with axes (u, v) =
            (x, y), (x, z), (y, z). Texel (iu, iv) is row offset + (iu - origin_u) * size_v + (iv - origin_v).
            Points outside a plane are clamped to its border, with zero gradient for that coordinate. If a plane has no
            texel, all values are 0.

    Returns:
        [N, C]. Differentiable with respect to `texels` and `points`. N = 0 gives an empty tensor.

    Raises:
        TypeError: a dtype is wrong.
        ValueError: a shape or device does not fit, `cell_size` is not positive, or `layout` exceeds the texels.

    Example:
        >>> layout = (0, 0, 0, 2, 2, 4, 0, 0, 2, 2, 8, 0, 0, 2, 2)
        >>> tri_plane_interpolate(torch.ones(12, 1), torch.tensor([[0.01, 0.02, 0.03]]), 0.04, layout)
        tensor([[3.]])
    """
    name = "tri_plane_interpolate"
    check_tensor(name, "texels", texels, ("P", "C"), TABLES)
    texels = wide(texels)
    check_tensor(name, "points", points, rows_shape(points, 3), texels.dtype, like=texels)
    check(cell_size > 0, name, "cell_size", "be positive", cell_size)
    check_plane_layout(name, layout, texels.shape[0])
    return unflat_rows(call(name, texels, flat_rows(points), cell_size, list(layout)), points.shape[:-1])


def as_row_numbers(ids: torch.Tensor) -> torch.Tensor:
    """Ids as int32, in which kernels number rows; an int64 beyond that range becomes -1, which is no row."""
    if ids.dtype == torch.int32:
        return ids
    fits = (ids >= 0) & (ids < _ROW_NUMBERS)
    return torch.where(fits, ids, -1).int()


def _is_plainly_chw(texels: torch.Tensor) -> bool:
    """Whether an image has as few rows as a photograph has channels, and as many channels as it has columns."""
    rows, columns, channels = texels.shape
    return rows in _PHOTO_CHANNELS and columns >= _FEWEST_COLUMNS and channels >= _MOST_FEATURES


def check_plane_layout(function: str, layout: Sequence[int], num_rows: int, argument: str = "layout") -> None:
    """Checks that a tri-plane layout is 15 integers that stay inside a table of `num_rows` texels."""
    check(len(layout) == 15, function, argument, "have 15 numbers", len(layout))
    for plane in range(3):
        offset, origin_u, origin_v, size_u, size_v = numbers = list(layout[5 * plane : 5 * plane + 5])
        fits = offset >= 0 and size_u >= 0 and size_v >= 0 and offset + size_u * size_v <= num_rows
        check(fits, function, argument, f"lie within the {num_rows} texels", numbers)
        near = max(abs(origin_u), abs(origin_v), size_u, size_v) <= _FARTHEST_TEXEL
        check(near, function, argument, "have origins and sizes within 2^30", numbers)


@torch.library.register_fake("spslam::trilinear_interpolate")
def _(embeddings, corner_ids, local_coords):
    return embeddings.new_empty(corner_ids.shape[0], embeddings.shape[1])


@torch.library.register_fake("spslam::bilinear_interpolate")
def _(texels, uv):
    return texels.new_empty(uv.shape[0], texels.shape[2])


@torch.library.register_fake("spslam::tri_plane_interpolate")
def _(texels, points, cell_size, layout):
    return texels.new_empty(points.shape[0], texels.shape[1])


def _fake_gradients(table, coords, need_table, need_coords):
    return (
        table.new_empty(table.shape if need_table else (0,)),
        coords.new_empty(coords.shape if need_coords else (0,)),
    )


@torch.library.register_fake("spslam::trilinear_interpolate_backward")
def _(grad, embeddings, corner_ids, local_coords, need_embeddings=True, need_local_coords=True):
    return _fake_gradients(embeddings, local_coords, need_embeddings, need_local_coords)


@torch.library.register_fake("spslam::bilinear_interpolate_backward")
def _(grad, texels, uv, need_texels=True, need_uv=True):
    return _fake_gradients(texels, uv, need_texels, need_uv)


@torch.library.register_fake("spslam::tri_plane_interpolate_backward")
def _(grad, texels, points, cell_size, layout, need_texels=True, need_points=True):
    return _fake_gradients(texels, points, need_texels, need_points)


def _save_trilinear(ctx, inputs, output):
    ctx.save_for_backward(*inputs)


def _trilinear_backward(ctx, grad):
    need_embeddings, _, need_local_coords = ctx.needs_input_grad
    grad_embeddings, grad_local_coords = call(
        "trilinear_interpolate_backward", grad, *ctx.saved_tensors, need_embeddings, need_local_coords
    )
    return grad_embeddings if need_embeddings else None, None, grad_local_coords if need_local_coords else None


def _save_bilinear(ctx, inputs, output):
    ctx.save_for_backward(*inputs)


def _bilinear_backward(ctx, grad):
    need_texels, need_uv = ctx.needs_input_grad
    grad_texels, grad_uv = call("bilinear_interpolate_backward", grad, *ctx.saved_tensors, need_texels, need_uv)
    return grad_texels if need_texels else None, grad_uv if need_uv else None


def _save_tri_plane(ctx, inputs, output):
    texels, points, ctx.cell_size, ctx.layout = inputs
    ctx.save_for_backward(texels, points)


def _tri_plane_backward(ctx, grad):
    need_texels, need_points = ctx.needs_input_grad[:2]
    grad_texels, grad_points = call(
        "tri_plane_interpolate_backward", grad, *ctx.saved_tensors, ctx.cell_size, ctx.layout, need_texels, need_points
    )
    return grad_texels if need_texels else None, grad_points if need_points else None, None, None


def _trilinear_composite(grad, embeddings, corner_ids, local_coords, need_embeddings=True, need_local_coords=True):
    complete = ((corner_ids >= 0) & (corner_ids < embeddings.shape[0])).all(1, keepdim=True)
    fractions = list(local_coords.unbind(1))
    weights, slopes = corner_weights(fractions, [torch.ones_like(fraction) for fraction in fractions])
    stencil = Stencil(torch.where(complete, corner_ids, -1), weights, slopes)
    return stencil_gradients(stencil, grad, embeddings, need_embeddings, need_local_coords)


def _bilinear_composite(grad, texels, uv, need_texels=True, need_uv=True):
    height, width, channels = texels.shape
    if height == 0 or width == 0:  # no point can be there either
        return torch.zeros_like(texels) if need_texels else None, torch.zeros_like(uv) if need_uv else None
    stencil = plane_stencil(axis_cell(uv[:, 0], width), axis_cell(uv[:, 1], height), 0, 1, width)
    table = texels.reshape(height * width, channels)
    to_table, to_uv = stencil_gradients(stencil, grad, table, need_texels, need_uv)
    return None if to_table is None else to_table.view(height, width, channels), to_uv


def _tri_plane_composite(grad, texels, points, cell_size, layout, need_texels=True, need_points=True):
    planes = []
    inverse = 1 / cell_size
    for plane, axes in enumerate(PLANE_AXES):
        offset, origin_u, origin_v, size_u, size_v = layout[5 * plane : 5 * plane + 5]
        if size_u == 0 or size_v == 0:
            return torch.zeros_like(texels) if need_texels else None, torch.zeros_like(points) if need_points else None
        u, v = (
            axis_cell(points[:, axis] * inverse - origin, size)
            for axis, origin, size in zip(axes, (origin_u, origin_v), (size_u, size_v), strict=True)
        )
        u, v = (cell._replace(slope=cell.slope * inverse) for cell in (u, v))
        planes.append(plane_stencil(u, v, offset, size_v, 1))
    return stencil_gradients(tri_plane_stencil(planes), grad, texels, need_texels, need_points)


for _op, _save, _backward, _composite, _rows in (
    ("trilinear_interpolate", _save_trilinear, _trilinear_backward, _trilinear_composite, (1, 2)),
    ("bilinear_interpolate", _save_bilinear, _bilinear_backward, _bilinear_composite, (1,)),
    ("tri_plane_interpolate", _save_tri_plane, _tri_plane_backward, _tri_plane_composite, (1,)),
):
    register_gradient(_op, _backward, _save, _composite)
    register_rows_vmap(_op, _rows)
    register_each_vmap(f"{_op}_backward")
