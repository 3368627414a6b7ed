"""Interpolation in feature grids of several resolutions: tri-planes, dense volumes and hashed volumes.

All levels lie in one table [P, C], a row per texel, so that one optimizer steps them and one op reads them. Values and
gradients are computed for all levels in one call; the same input gives the same bits, as in `interpolation`.
"""

import torch

from spslam.ops import _library  # noqa: F401
from spslam.ops._autograd import register_gradient
from spslam.ops._checks import TABLES, check_tensor, flat_rows, rows_shape, unflat_rows, wide
from spslam.ops._dispatch import call
from spslam.ops._public import public_op
from spslam.ops._stencils import (
    PLANE_AXES,
    Stencil,
    axis_cell,
    corner_rows,
    corner_weights,
    join,
    plane_stencil,
    stencil_gradients,
    tri_plane_stencil,
)
from spslam.ops._vmap import register_each_vmap, register_rows_vmap
from spslam.ops.grid_levels import TriPlaneLevels, VolumeLevels

_TRI_PLANES, _VOLUME = 0, 1
_LEVEL_INTEGERS, _LEVEL_NUMBERS = 7, 6
_PRIMES = (1, 2654435761, 805459861)  # of the hash, see csrc/kernels/grid_stencils.h


@public_op()
def interpolate_tri_planes(
    table: torch.Tensor, points: torch.Tensor, grid: TriPlaneLevels, concatenate: bool = False
) -> torch.Tensor:
    """Features of points in tri-planes of all levels: on each level the sum of three bilinear values (equation 3).

    Args:
        table: [P, C] float32 or float64 with P = grid.num_rows, see `tri_planes_from_chw`; or float16 or bfloat16,
            read as float32.
        points: [N, 3] or [..., 3] of the same dtype (float32 for smaller tables), meters. Points outside of the bounds
            are clamped to them, with zero gradient for that coordinate. NaN gives NaN for its point.
        grid: the levels.
        concatenate: whether each level has channels of its own in the result, in order; else levels add up.

    Returns:
        [N, C], or [N, levels * C] concatenated. Differentiable to any order with respect to `table` and `points`. N = 0
        gives an empty tensor.

    Raises:
        TypeError: a dtype is wrong.
        ValueError: a shape or device does not fit.

    Example:
        >>> grid = TriPlaneLevels.from_sizes([(0, 0, 0), (1, 1, 1)], [(4, 4, 4), (8, 8, 8)])
        >>> interpolate_tri_planes(torch.ones(grid.num_rows, 2), torch.rand(5, 3), grid, concatenate=True).shape
        torch.Size([5, 4])
    """
    return _interpolate("interpolate_tri_planes", table, points, grid, concatenate)


@public_op()
def interpolate_volumes(
    table: torch.Tensor, points: torch.Tensor, grid: VolumeLevels, concatenate: bool = False
) -> torch.Tensor:
    """Features of points in volumes of all levels, trilinear on each.

    Args:
        table: [P, C] float32 or float64 with P = grid.num_rows; or float16 or bfloat16, read as float32. Vertex
            (x, y, z) of a dense level is its row (x size_y + y) size_z + z.
        points: [N, 3] or [..., 3] of the same dtype (float32 for smaller tables), meters. Points outside of the bounds
            are clamped to them, with zero gradient for that coordinate. NaN gives NaN for its point.
        grid: the levels.
        concatenate: whether each level has channels of its own in the result, in order; else levels add up.

    Returns:
        [N, C], or [N, levels * C] concatenated. Differentiable to any order with respect to `table` and `points`. N = 0
        gives an empty tensor.

    Raises:
        TypeError: a dtype is wrong.
        ValueError: a shape or device does not fit.

    Example:
        >>> grid = VolumeLevels.from_sizes([(0, 0, 0), (1, 1, 1)], [(2, 2, 2)])
        >>> interpolate_volumes(torch.arange(8.0)[:, None], torch.tensor([[0.0, 0.5, 1.0]]), grid)
        tensor([[2.]])
    """
    return _interpolate("interpolate_volumes", table, points, grid, concatenate)


def _interpolate(
    name: str, table: torch.Tensor, points: torch.Tensor, grid: TriPlaneLevels | VolumeLevels, concatenate: bool
) -> torch.Tensor:
    check_tensor(name, "table", table, ("P", "C"), TABLES)
    check_tensor(name, "table", table, (grid.num_rows, "C"), TABLES)
    table = wide(table)
    check_tensor(name, "points", points, rows_shape(points, 3), table.dtype, like=table)
    kind = _TRI_PLANES if isinstance(grid, TriPlaneLevels) else _VOLUME
    integers, numbers = _packed(grid, kind)
    out = call("grid_interpolate", table, flat_rows(points), integers, numbers, kind, concatenate)
    return unflat_rows(out, points.shape[:-1])


def _packed(grid: TriPlaneLevels | VolumeLevels, kind: int) -> tuple[list[int], list[float]]:
    """The levels as the op takes them: integers and numbers in the order of csrc/bindings/grid_interpolation.cpp."""
    integers: list[int] = []
    numbers: list[float] = []
    for level in grid.levels:
        x, y, z = level.size
        first = level.first_row
        offsets = (first, first + x * y, first + x * (y + z)) if kind == _TRI_PLANES else (first, 0, 0)
        integers += [*offsets, x, y, z, level.num_rows if level.hashed else 0]
        for lower, upper, size in zip(level.lower, level.upper, level.size, strict=True):
            scale = (size - 1 if grid.align_corners else size) / (upper - lower)
            numbers += [scale, -lower * scale - (0.0 if grid.align_corners else 0.5)]
    return integers, numbers


@torch.library.register_fake("spslam::grid_interpolate")
def _(table, points, levels, transforms, kind, concatenated):
    width = table.shape[1] * (len(levels) // _LEVEL_INTEGERS if concatenated else 1)
    return table.new_empty(points.shape[0], width)


@torch.library.register_fake("spslam::grid_interpolate_backward")
def _(grad, table, points, levels, transforms, kind, concatenated, need_table=True, need_points=True):
    to_table = table.new_empty(table.shape if need_table else (0,))
    return to_table, points.new_empty(points.shape if need_points else (0,))


def _save(ctx, inputs, output):
    table, points, *ctx.grid = inputs
    ctx.save_for_backward(table, points)


def _backward(ctx, grad):
    need_table, need_points = ctx.needs_input_grad[:2]
    to_table, to_points = call(
        "grid_interpolate_backward", grad, *ctx.saved_tensors, *ctx.grid, need_table, need_points
    )
    return to_table if need_table else None, to_points if need_points else None, None, None, None, None


def _composite(grad, table, points, levels, transforms, kind, concatenated, need_table=True, need_points=True):
    """`grid_interpolate_backward` in ops that are differentiable."""
    stencils = []
    for i in range(len(levels) // _LEVEL_INTEGERS):
        integers = levels[_LEVEL_INTEGERS * i : _LEVEL_INTEGERS * (i + 1)]
        numbers = transforms[_LEVEL_NUMBERS * i : _LEVEL_NUMBERS * (i + 1)]
        stencils.append(_level_stencil(points, integers, numbers, kind))
    if not concatenated:
        return stencil_gradients(join(stencils, 1), grad, table, need_table, need_points)
    own = join(stencils, 0)  # each level of a point is a point of its own
    to_table, to_own = stencil_gradients(own, grad.reshape(-1, table.shape[1]), table, need_table, need_points)
    return to_table, None if to_own is None else to_own.view(points.shape[0], -1, 3).sum(1)


def _level_stencil(points: torch.Tensor, integers: list[int], numbers: list[float], kind: int) -> Stencil:
    offsets, size, hash_rows = integers[:3], integers[3:6], integers[6]
    cells = [axis_cell(points[:, a] * numbers[2 * a] + numbers[2 * a + 1], size[a]) for a in range(3)]
    cells = [cell._replace(slope=cell.slope * scale) for cell, scale in zip(cells, numbers[::2], strict=True)]
    if kind == _VOLUME:
        if hash_rows:
            rows = _hashed_rows(cells) & (hash_rows - 1)
        else:
            strides = (size[1] * size[2], size[2], 1)
            ends = [(cell.lower * stride, cell.upper * stride) for cell, stride in zip(cells, strides, strict=True)]
            rows = corner_rows([low for low, _ in ends], [high for _, high in ends])
        weights, by_axis = corner_weights([cell.fraction for cell in cells], [cell.slope for cell in cells])
        return Stencil((offsets[0] + rows).int(), weights, by_axis)
    axes = zip(offsets, PLANE_AXES, strict=True)
    return tri_plane_stencil([plane_stencil(cells[u], cells[v], offset, size[v], 1) for offset, (u, v) in axes])


def _hashed_rows(cells: list) -> torch.Tensor:
    """The hash of the eight corners [N, 8], of which the low bits count."""
    products = [
        torch.stack([cell.lower * prime, cell.upper * prime], 1) for cell, prime in zip(cells, _PRIMES, strict=True)
    ]
    x, y, z = products
    return (z[:, :, None, None] ^ y[:, None, :, None] ^ x[:, None, None, :]).flatten(1)


def _title(args: tuple) -> str:
    """The public function, by the first integer among the arguments: the kind."""
    kind = next(value for value in args if isinstance(value, int))
    return "interpolate_tri_planes" if kind == _TRI_PLANES else "interpolate_volumes"


register_rows_vmap("grid_interpolate", (1,))
register_each_vmap("grid_interpolate_backward")
register_gradient("grid_interpolate", _backward, _save, _composite, _title)
