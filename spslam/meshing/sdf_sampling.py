"""Samples a signed distance field on the blocks near its surface.

A block is a cube of space with integer coordinates: `world = coords * block_size_m`. Blocks far from the surface are
not sampled densely, so time and memory are proportional to the area of the surface, not to the volume.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable

import torch

from spslam import ops

# Signed distance (m) and whether it is known, at float32 points [N, 3].
SignedDistance = Callable[[torch.Tensor], tuple[torch.Tensor, torch.Tensor]]

# Every point of a block lies within sqrt(3) / 4 block edges of one of the eight probes at its quarter points.
_PROBES = torch.tensor(list(itertools.product((0.25, 0.75), repeat=3)), dtype=torch.float32)
_PROBE_REACH = 3**0.5 / 4


def near_surface(
    coords: torch.Tensor, block_size_m: float, sdf: SignedDistance, max_slope: float, chunk_points: int
) -> torch.Tensor:
    """Selects the blocks that the surface may pass through.

    A block is left out if the eight probes in it have the same sign, and none is so close to 0 that a field with a
    gradient of at most `max_slope` could change its sign in between. Blocks without a known probe are left out too.

    Args:
        coords: int32 [M, 3].
        block_size_m: edge length of a block.
        sdf: the field.
        max_slope: bound on the gradient of the field; 1 for an exact distance.
        chunk_points: largest number of points in one call of `sdf`.

    Returns:
        int32 [m, 3], in the order of `coords`.
    """
    kept = [coords[:0]]
    for chunk in coords.split(max(chunk_points // len(_PROBES), 1)):
        values, known = _evaluate(sdf, chunk, _PROBES, block_size_m)
        close = ((values.abs() < max_slope * _PROBE_REACH * block_size_m) & known).any(1)
        both_signs = ((values < 0) & known).any(1) & ((values >= 0) & known).any(1)
        kept.append(chunk[close | both_signs])
    return torch.cat(kept)


def near_surface_parts(
    coords: torch.Tensor, parts: int, part_size_m: float, sdf: SignedDistance, max_slope: float, chunk_points: int
) -> torch.Tensor:
    """Divides each block into parts^3 blocks and selects those that the surface may pass through, as `near_surface`."""
    offsets = torch.tensor(list(itertools.product(range(parts), repeat=3)), dtype=torch.int32, device=coords.device)
    kept = [coords[:0]]
    for chunk in coords.split(max(chunk_points // len(offsets), 1)):
        divided = (chunk[:, None] * parts + offsets).reshape(-1, 3)
        kept.append(near_surface(divided, part_size_m, sdf, max_slope, chunk_points))
    return torch.cat(kept)


def sample_blocks(
    coords: torch.Tensor, block_size_m: float, n: int, sdf: SignedDistance, chunk_points: int
) -> torch.Tensor:
    """Samples the field at the corners of n x n x n cubes in each block, as input of `ops.marching_cubes`.

    A sample that a block shares with a neighbor on its upper side is evaluated only for that neighbor, and NaN in the
    block itself: `ops.marching_cubes` reads the neighbor's value.

    Args:
        coords: int32 [M, 3], distinct.
        block_size_m: edge length of a block.
        n: cubes per axis.
        sdf: the field.
        chunk_points: largest number of points in one call of `sdf`.

    Returns:
        float32 [M, n + 1, n + 1, n + 1], m; NaN where the field is not known.
    """
    values = torch.full((len(coords), n + 1, n + 1, n + 1), torch.nan, device=coords.device)
    has_upper = _upper_neighbors(coords)
    margin = _border_margin(coords)
    for upper in itertools.product((False, True), repeat=3):
        rows = torch.nonzero(~_owned_by_upper(has_upper, upper))[:, 0]
        region = tuple(slice(n, n + 1) if side else slice(0, n) for side in upper)
        axes = [torch.arange(n + 1)[side] / n for side in region]
        local = torch.cartesian_prod(*axes).clamp(margin, 1 - margin)
        shape = [len(axis) for axis in axes]
        for chunk in rows.split(max(chunk_points // len(local), 1)):
            sampled, known = _evaluate(sdf, coords[chunk], local, block_size_m)
            sampled = torch.where(known, sampled, torch.nan).view(-1, *shape)
            values[(chunk, *region)] = sampled
    return values


def _evaluate(
    sdf: SignedDistance, coords: torch.Tensor, local: torch.Tensor, block_size_m: float
) -> tuple[torch.Tensor, torch.Tensor]:
    """The field [m, P], and whether it is known, at P local coordinates (in block edges) within each of m blocks."""
    local = local.to(coords.device)
    points = ((coords[:, None] + local) * block_size_m).reshape(-1, 3)
    values, known = sdf(points)
    shape = len(coords), len(local)
    return values.view(shape), known.view(shape)


def _border_margin(coords: torch.Tensor) -> float:
    """Distance, in block edges, that samples keep from the border of a block.

    A sample must be looked up in its own block, as there may be no block on the other side. So it must not leave the
    block by rounding to float32 meters and back: four roundings, which are half of this margin.
    """
    if len(coords) == 0:
        return 0.0
    largest = coords.abs().max().item() + 1
    return largest * 2.0**-21


def _upper_neighbors(coords: torch.Tensor) -> dict[tuple[int, int, int], torch.Tensor]:
    """For each offset to a neighbor on the upper side, bool [M]: whether that neighbor is one of the blocks."""
    capacity = max(2, 1 << (2 * len(coords) - 1).bit_length())
    keys, values = ops.new_voxel_hash(capacity, coords.device)
    ops.voxel_hash_build_(keys, values, coords)
    steps = [(x, y, z) for x in (0, 1) for y in (0, 1) for z in (0, 1) if x or y or z]
    return {
        step: ops.voxel_hash_find(keys, values, coords + torch.tensor(step, dtype=torch.int32, device=coords.device))
        >= 0
        for step in steps
    }


def _owned_by_upper(has_upper: dict[tuple[int, int, int], torch.Tensor], upper: tuple[bool, ...]) -> torch.Tensor:
    """Bool [M]: whether a neighbor has the samples on the upper side along the axes where `upper` is true."""
    owned = torch.zeros_like(next(iter(has_upper.values())))
    for step, exists in has_upper.items():
        if all(side or not moved for side, moved in zip(upper, step, strict=True)):
            owned |= exists
    return owned
