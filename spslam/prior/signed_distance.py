"""Signed distances of batches of solids, each in its own frame: negative inside, in the unit of the coordinates.

Every function takes `points` [B, N, 3] and parameters with the batch dimension first, and returns [B, N]. Planes,
spheres, cylinders, boxes and tori are exact. Superquadrics and wavy sheets have no closed form: their foot points are
found iteratively, and may be a local minimum where two sides are almost equally near.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

_RELAXATION = 0.5

Implicit = Callable[[Tensor], tuple[Tensor, Tensor]]


def plane(points: Tensor) -> Tensor:
    """The half space z < 0."""
    return points[..., 2]


def sphere(points: Tensor, radius: Tensor) -> Tensor:
    """A ball around the origin; `radius` [B, 1]."""
    return points.norm(dim=-1) - radius


def cylinder(points: Tensor, radius: Tensor) -> Tensor:
    """An infinite cylinder around the z axis; `radius` [B, 1]."""
    return points[..., :2].norm(dim=-1) - radius


def box(points: Tensor, half_size: Tensor) -> Tensor:
    """An axis-aligned box around the origin; `half_size` [B, 3]."""
    outside = points.abs() - half_size[:, None]
    return outside.clamp_min(0).norm(dim=-1) + outside.amax(-1).clamp_max(0)


def torus(points: Tensor, radius: Tensor, tube_radius: Tensor) -> Tensor:
    """A torus around the z axis; `radius` of its circle and `tube_radius`, both [B, 1]."""
    from_circle = points[..., :2].norm(dim=-1) - radius
    return torch.hypot(from_circle, points[..., 2]) - tube_radius


def superquadric(points: Tensor, half_size: Tensor, exponent: Tensor, iterations: int = 8) -> Tensor:
    """The solid `sum |x_i / h_i|^e < 1`; `half_size` h [B, 3], `exponent` e [B, 1], at least 2."""
    half_size, exponent = half_size[:, None], exponent[:, None]

    def gauge(x: Tensor) -> tuple[Tensor, Tensor]:
        scaled = (x.abs() / half_size).clamp_min(1e-6)
        value = scaled.pow(exponent).sum(-1, keepdim=True).pow(1 / exponent)
        gradient = x.sign() * (scaled / value).pow(exponent - 1) / half_size
        return value[..., 0] - 1, gradient

    return _foot_point_distance(points, gauge, iterations)


def wavy_sheet(points: Tensor, amplitude: Tensor, wave_number: Tensor, iterations: int = 8) -> Tensor:
    """The region below `z = a (sin kx + sin ky)`; `amplitude` a and `wave_number` k, both [B, 1]."""
    a, k = amplitude, wave_number

    def height_above(x: Tensor) -> tuple[Tensor, Tensor]:
        u, v = k * x[..., 0], k * x[..., 1]
        gradient = torch.stack([-a * k * u.cos(), -a * k * v.cos(), torch.ones_like(u)], -1)
        return x[..., 2] - a * (u.sin() + v.sin()), gradient

    return _foot_point_distance(points, height_above, iterations)


def _foot_point_distance(points: Tensor, implicit: Implicit, iterations: int) -> Tensor:
    """Distance to the zero set of a function: iterated projection onto the tangent plane at the last foot point.

    One iteration gives the first-order distance f / |grad f|. Later iterations are relaxed, because full steps diverge
    outside an edge with a radius smaller than the distance.
    """
    value, gradient = implicit(points)
    sign, foot, share = value.sign(), points, 1.0
    for _ in range(iterations):
        along = (((foot - points) * gradient).sum(-1) - value) / gradient.square().sum(-1).clamp_min(1e-12)
        foot = foot + share * (points + along[..., None] * gradient - foot)
        value, gradient = implicit(foot)
        share = _RELAXATION
    return sign * (foot - points).norm(dim=-1)
