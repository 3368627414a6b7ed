"""Interpolation written as sums over rows of a table: what its derivatives of second and higher order are made of.

A stencil is a list of row numbers and weights for each point. Weights are torch's operations on the coordinates, sums
over rows are three ops that are each other's derivatives, so derivatives of any order come out of them:

    row_gather(table, rows, weights)  [N, C]  sum_k weights[n, k] table[rows[n, k]]
    row_scatter(grad, rows, weights)  [P, C]  its derivative by the table
    row_dot(grad, table, rows)        [N, K]  its derivative by the weights
"""

from typing import NamedTuple

import torch

from spslam.ops import _library  # noqa: F401
from spslam.ops._autograd import register_gradient
from spslam.ops._dispatch import call
from spslam.ops._vmap import register_each_vmap

PLANE_AXES = ((0, 1), (0, 2), (1, 2))  # (u, v) of the planes xy, xz and yz


class Stencil(NamedTuple):
    """Rows of a table with their weights, and the weights' derivatives.

    Attributes:
        rows: int32 [N, K], -1 where there is none.
        weights: [N, K].
        slopes: [N, K, A], derivatives of the weights by the A coordinates.
    """

    rows: torch.Tensor
    weights: torch.Tensor
    slopes: torch.Tensor


class AxisCell(NamedTuple):
    """The texels on both sides of a position on an axis.

    Attributes:
        lower, upper: int64 [N].
        fraction: [N], between them.
        slope: [N], d fraction / d position: 0 where the position was clamped.
    """

    lower: torch.Tensor
    upper: torch.Tensor
    fraction: torch.Tensor
    slope: torch.Tensor


def axis_cell(position: torch.Tensor, size: int) -> AxisCell:
    """The cell of positions in texels on an axis of `size` texels, clamped to its ends as the kernels do."""
    last = size - 1
    inside = (position > 0) & (position < last)
    clamped = torch.where(inside, position, position.detach().clamp(0, last))
    lower = clamped.detach().nan_to_num(0).floor().clamp(max=max(last - 1, 0))
    whole = lower.long()
    return AxisCell(whole, whole + int(size > 1), clamped - lower, inside.to(position.dtype))


def corner_weights(fractions: list[torch.Tensor], slopes: list[torch.Tensor]) -> tuple[torch.Tensor, torch.Tensor]:
    """Weights [N, 2^A] of the corners of a cell, and their derivatives [N, 2^A, A] by the coordinates.

    Args:
        fractions: A tensors [N], the place in the cell.
        slopes: A tensors [N], d fraction / d coordinate.

    Corner k lies at offset k >> a & 1 along axis a.
    """
    axes = len(fractions)
    sides = [torch.stack([1 - fraction, fraction], 1) for fraction in fractions]
    signs = fractions[0].new_tensor([-1.0, 1.0])
    steps = [slope[:, None] * signs for slope in slopes]

    def product(factors: list[torch.Tensor]) -> torch.Tensor:
        result = factors[0]
        for factor in factors[1:]:
            result = (factor[:, :, None] * result[:, None]).flatten(1)
        return result

    derivatives = [product([steps[b] if a == b else sides[b] for b in range(axes)]) for a in range(axes)]
    return product(sides), torch.stack(derivatives, 2)


def corner_rows(lower: list[torch.Tensor], upper: list[torch.Tensor]) -> torch.Tensor:
    """Sums [N, 2^A] of one number per axis, `lower` or `upper`, in the order of `corner_weights`."""
    rows = torch.stack([lower[0], upper[0]], 1)
    for low, high in zip(lower[1:], upper[1:], strict=True):
        rows = (torch.stack([low, high], 1)[:, :, None] + rows[:, None]).flatten(1)
    return rows


def join(stencils: list[Stencil], axis: int) -> Stencil:
    """One stencil of several of the same points: their lists one after another (1), or as lists of their own (0)."""
    parts = [torch.stack(part, 1) for part in zip(*stencils, strict=True)]  # [N, stencils, K, ...]
    return Stencil(*(part.flatten(axis, axis + 1) for part in parts))


def plane_stencil(u: AxisCell, v: AxisCell, offset: int, stride_u: int, stride_v: int) -> Stencil:
    """The four texels around points of a plane whose texel (0, 0) is row `offset`; slopes [N, 4, 2] by (u, v)."""
    rows = corner_rows([u.lower * stride_u, v.lower * stride_v], [u.upper * stride_u, v.upper * stride_v])
    return Stencil((offset + rows).int(), *corner_weights([u.fraction, v.fraction], [u.slope, v.slope]))


def tri_plane_stencil(planes: list[Stencil]) -> Stencil:
    """One stencil of the planes xy, xz and yz, whose slopes are by their own (u, v); with slopes by (x, y, z)."""
    parts = []
    for plane, (u, v) in zip(planes, PLANE_AXES, strict=True):
        columns = [torch.zeros_like(plane.weights)] * 3
        columns[u], columns[v] = plane.slopes[..., 0], plane.slopes[..., 1]
        parts.append(plane._replace(slopes=torch.stack(columns, 2)))
    return join(parts, 1)


def stencil_gradients(
    stencil: Stencil, grad: torch.Tensor, table: torch.Tensor, need_table: bool, need_coords: bool
) -> tuple[torch.Tensor | None, torch.Tensor | None]:
    """Gradients of the table and of the coordinates of the stencil's points, differentiable themselves.

    Args:
        stencil: of N points.
        grad: [N, C], gradient of the interpolated values.
        table: [P, C].
        need_table, need_coords: which of the two are wanted.
    """
    to_table = call("row_scatter", grad, stencil.rows, stencil.weights, table.shape[0]) if need_table else None
    if not need_coords:
        return to_table, None
    return to_table, (call("row_dot", grad, table, stencil.rows)[..., None] * stencil.slopes).sum(1)


@torch.library.register_fake("spslam::row_gather")
def _(table, rows, weights):
    return table.new_empty(rows.shape[0], table.shape[1])


@torch.library.register_fake("spslam::row_scatter")
def _(grad, rows, weights, num_rows):
    return grad.new_empty(num_rows, grad.shape[1])


@torch.library.register_fake("spslam::row_dot")
def _(grad, table, rows):
    return grad.new_empty(rows.shape)


def _save(ctx, inputs, output):
    ctx.save_for_backward(*inputs[:3])


def _gather_backward(ctx, grad):
    table, rows, weights = ctx.saved_tensors
    need_table, _, need_weights = ctx.needs_input_grad
    to_table = call("row_scatter", grad, rows, weights, table.shape[0]) if need_table else None
    return to_table, None, call("row_dot", grad, table, rows) if need_weights else None


def _scatter_backward(ctx, grad_rows):
    grad, rows, weights = ctx.saved_tensors
    need_grad, _, need_weights, _ = ctx.needs_input_grad
    to_grad = call("row_gather", grad_rows, rows, weights) if need_grad else None
    return to_grad, None, call("row_dot", grad, grad_rows, rows) if need_weights else None, None


def _dot_backward(ctx, grad_dots):
    grad, table, rows = ctx.saved_tensors
    need_grad, need_table, _ = ctx.needs_input_grad
    to_grad = call("row_gather", table, rows, grad_dots) if need_grad else None
    return to_grad, call("row_scatter", grad, rows, grad_dots, table.shape[0]) if need_table else None, None


for _op, _backward in (
    ("row_gather", _gather_backward),
    ("row_scatter", _scatter_backward),
    ("row_dot", _dot_backward),
):
    register_each_vmap(_op)
    register_gradient(_op, _backward, _save)
