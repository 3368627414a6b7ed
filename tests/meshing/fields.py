"""Analytic signed distance fields (m, negative inside solids) for the tests of meshes."""

import itertools

import torch

ROOM_HALF_M = (2.503, 2.497, 1.501)
BALL_CENTER_M, BALL_RADIUS_M = (0.4, -0.3, -0.2), 0.6


def _known(distance):
    return distance, torch.ones_like(distance, dtype=torch.bool)


def room(points):
    """A closed room with a ball in it."""
    outside = points.abs() - torch.tensor(ROOM_HALF_M, device=points.device)
    walls = -(outside.clamp(min=0).norm(dim=1) + outside.amax(1).clamp(max=0))
    ball = (points - torch.tensor(BALL_CENTER_M, device=points.device)).norm(dim=1) - BALL_RADIUS_M
    return _known(torch.minimum(walls, ball))


def sphere(radius_m):
    return lambda points: _known(points.norm(dim=1) - radius_m)


def plane(normal, offset_m):
    """The plane n . p = offset; n may have any length."""
    return lambda points: _known(points @ torch.tensor(normal, device=points.device) - offset_m)


def cells_within(half_extent, device="cpu"):
    """All cells with coordinates in [-half_extent, half_extent - 1], int32 [M, 3]."""
    axis = range(-half_extent, half_extent)
    return torch.tensor(list(itertools.product(axis, repeat=3)), dtype=torch.int32, device=device)


def cells_near(field, half_extents_m, cell_size_m, reach_m, device="cpu"):
    """The cells of a box whose center is within `reach_m` of the surface."""
    axes = [torch.arange(-int(h / cell_size_m) - 3, int(h / cell_size_m) + 3) for h in half_extents_m]
    coords = torch.cartesian_prod(*axes).int().to(device)
    distance, _ = field((coords + 0.5) * cell_size_m)
    return coords[distance.abs() < reach_m]
