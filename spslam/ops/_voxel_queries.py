"""Sets of lattice points around positions: which vertices a point needs, and which of a hash lie near it.

Plain torch on packed coordinates, as `voxel_hash` describes them; `VoxelHash` looks the results up.
"""

import math

import torch

from spslam.ops.voxel_hash import VOXEL_COORD_MAX, VOXEL_COORD_MIN, voxel_hash_find

HashTable = tuple[torch.Tensor, torch.Tensor]  # keys and values

_BITS = 21  # of a coordinate in a key
_CHUNK = 1 << 22  # lattice points that are listed at a time


def as_voxel_coords(coords: torch.Tensor) -> torch.Tensor:
    """Integer coordinates as int32, in which those out of range stay out of range."""
    return coords if coords.dtype == torch.int32 else coords.clamp(-(2**31), 2**31 - 1).int()


def vertices_around(points: torch.Tensor, voxel_size: float, band: float) -> torch.Tensor:
    """The vertices of all cells that the cubes of half side `band` around points touch, int32 [M, 3] in sorted order.

    Points that are not finite, or whose vertices are out of range, have none.
    """
    # As look-ups round: a point on a side of a cell is in the same one of both for them.
    at = (points * (1 / torch.tensor(voxel_size, dtype=points.dtype))).double()
    lower = torch.floor(at - band / voxel_size)
    upper = torch.floor(at + band / voxel_size) + 1
    in_range = ((lower >= VOXEL_COORD_MIN) & (upper <= VOXEL_COORD_MAX)).all(1)
    low, high = lower[in_range].long(), upper[in_range].long()
    keys, spans = pack(low), high - low
    found = []
    for span in torch.unique(spans, dim=0).tolist():  # at most two lengths per axis
        of_span = torch.unique(keys[(spans == torch.tensor(span, device=keys.device)).all(1)])
        steps = pack(lattice([0, 0, 0], span, keys.device)) - pack(torch.zeros(1, 3).long().to(keys.device))
        found += [torch.unique(part[:, None] + steps) for part in of_span.split(max(_CHUNK // len(steps), 1))]
    return unpack(torch.unique(torch.cat(found)) if found else keys).int()


def neighbor_ids(hash_table: HashTable, coords: torch.Tensor, offsets: torch.Tensor) -> torch.Tensor:
    """Ids int32 [N, K] of coords int32 [N, 3] + offsets int32 [K, 3], -1 where absent."""
    rows, length = coords.shape[0], offsets.shape[0]
    sums = coords.long()[:, None] + offsets.long()  # which may need more than 32 bits
    return voxel_hash_find(*hash_table, as_voxel_coords(sums.reshape(rows * length, 3))).view(rows, length)


def nearest_vertices(
    hash_table: HashTable, points: torch.Tensor, voxel_size: float, radius: float, k: int | None
) -> tuple[torch.Tensor, torch.Tensor]:
    """Ids int32 [N, k] and distances [N, k] of the vertices within a radius, nearest first, then -1 and infinity.

    With k None as many columns as the point with the most vertices has.
    """
    offsets = _offsets_within(radius / voxel_size, points.device)
    at_once = max(_CHUNK // len(offsets), 1)
    parts = [_within(hash_table, part, voxel_size, radius, offsets) for part in points.split(at_once)]
    rows = torch.cat([part[0] + i * at_once for i, part in enumerate(parts)])
    ids, squared = (torch.cat([part[i] for part in parts]) for i in (1, 2))
    # Stable, so that of two at the same distance the first in the order of (x, y, z) comes first.
    by_distance = squared.sort(stable=True).indices
    order = by_distance[rows[by_distance].sort(stable=True).indices]
    rows, ids, squared = rows[order], ids[order], squared[order]
    counts = torch.bincount(rows, minlength=points.shape[0])
    place = torch.arange(len(rows), device=rows.device) - (counts.cumsum(0) - counts)[rows]
    columns = k if k is not None else int(counts.max()) if len(counts) else 0
    found_ids = torch.full((points.shape[0], columns), -1, dtype=torch.int32, device=points.device)
    distances = points.new_full((points.shape[0], columns), math.inf)
    kept = place < columns
    found_ids[rows[kept], place[kept]] = ids[kept]
    distances[rows[kept], place[kept]] = squared[kept].sqrt()
    return found_ids, distances


def _within(
    hash_table: HashTable, points: torch.Tensor, voxel_size: float, radius: float, offsets: torch.Tensor
) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Pairs of a point and a vertex within the radius: row of the point, id, squared distance."""
    base = torch.floor(points / voxel_size)
    known = (base.abs() <= 2 * VOXEL_COORD_MAX).all(1, keepdim=True)  # not NaN, not far away
    base = torch.where(known, base, 4 * VOXEL_COORD_MAX).int()
    ids = neighbor_ids(hash_table, base, offsets)
    rows, columns = (ids >= 0).nonzero(as_tuple=True)
    positions = (base[rows] + offsets[columns]).to(points.dtype) * voxel_size
    squared = (positions - points[rows]).square().sum(1)
    near = squared <= radius * radius
    return rows[near], ids[rows, columns][near], squared[near]


def _offsets_within(reach: float, device: torch.device) -> torch.Tensor:
    """Lattice points int32 [K, 3] that may lie within `reach` voxels of a point of the cell [0, 1]^3, sorted."""
    steps = math.ceil(reach)
    offsets = lattice([-steps] * 3, [steps + 1] * 3, device)
    outside = (offsets - offsets.clamp(0, 1)).square().sum(1)
    return offsets[outside <= reach * reach].int()


def lattice(lower: list[int], upper: list[int], device: torch.device) -> torch.Tensor:
    """All integer points int64 [K, 3] between two corners, both included."""
    axes = [torch.arange(low, high + 1, device=device) for low, high in zip(lower, upper, strict=True)]
    return torch.cartesian_prod(*axes)


def pack(coords: torch.Tensor) -> torch.Tensor:
    """Keys of coordinates in range, which sort as (x, y, z) do."""
    x, y, z = (coords.long() - VOXEL_COORD_MIN).unbind(-1)
    return (x << 2 * _BITS) + (y << _BITS) + z


def unpack(keys: torch.Tensor) -> torch.Tensor:
    """The reverse of `pack`, int64 [N, 3]."""
    mask = (1 << _BITS) - 1
    return torch.stack([keys >> 2 * _BITS, keys >> _BITS & mask, keys & mask], 1) + VOXEL_COORD_MIN
