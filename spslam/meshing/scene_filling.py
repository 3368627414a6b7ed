"""Fills unknown voxels of a fused volume with the distances of a map, moved so that the two meet."""

from __future__ import annotations

import torch

from spslam import ops
from spslam.meshing.extract import CHUNK_POINTS
from spslam.ops.tsdf import BLOCK_SIDE
from spslam.scene import Scene

# Differences are added as whole numbers of this many m, so that their sum does not depend on its order.
_UNIT_M = 2.0**-24
# A measured voxel and the map that differ by more do not tell of the same surface.
_MOST_DIFFERENCE_VOXELS = 3.0
# Measured voxels farther from the surface than this do not say where the map's lies.
_NEAR_VOXELS = 2.0


def fill_with_scene(volume: ops.TsdfVolume, values: torch.Tensor, scene: Scene) -> torch.Tensor:
    """The volume's distances with the map's in unknown voxels.

    Args:
        volume: fused frames.
        values: float32 [B, 512] its distances, m, NaN where unknown.
        scene: the map.

    Returns:
        float32 [B, 512]; NaN where the map knows nothing either.
    """
    filling = _SceneFilling(volume, scene)
    chunk_blocks = max(CHUNK_POINTS // values.shape[1], 1)
    sums, counts = filling.no_differences()
    for rows in torch.arange(len(values), device=values.device).split(chunk_blocks):
        filling.add_differences(rows, values[rows], sums, counts)
    shift = torch.where(counts > 0, sums.float() * _UNIT_M / counts.clamp(min=1), 0.0)
    filled = values.clone()
    for rows in torch.arange(len(values), device=values.device).split(chunk_blocks):
        filled[rows] = filling.fill(rows, values[rows], shift)
    return filled


class _SceneFilling:
    """The map as seen from a volume's voxels."""

    def __init__(self, volume: ops.TsdfVolume, scene: Scene):
        self._volume, self._scene = volume, scene
        axes = [torch.arange(BLOCK_SIDE, device=volume.sdf.device)] * 3
        self._offsets = torch.cartesian_prod(*axes).int()

    def no_differences(self) -> tuple[torch.Tensor, torch.Tensor]:
        """Sums and counts, int64 [V], for each of the map's vertices."""
        zeros = torch.zeros(self._scene.volume.num_voxels, dtype=torch.int64, device=self._volume.sdf.device)
        return zeros, zeros.clone()

    def add_differences(
        self, rows: torch.Tensor, values: torch.Tensor, sums: torch.Tensor, counts: torch.Tensor
    ) -> None:
        """Adds, to the vertices of the cells around measured voxels, how far they are from the map."""
        size = self._volume.voxel_size
        near = _places(values.abs() < _NEAR_VOXELS * size)
        points = self._points(rows, near)
        distance, known = self._distances(points)
        difference = values[near] - distance
        known &= difference.abs() < _MOST_DIFFERENCE_VOXELS * size
        agreeing = known.nonzero()[:, 0]
        corner_ids, _, _ = self._scene.volume.lookup(points[agreeing])
        units = (difference[agreeing] / _UNIT_M).round().long()
        ids = corner_ids.long().flatten()
        inside = (ids >= 0).nonzero()[:, 0]
        ids = ids[inside]
        sums.index_add_(0, ids, units.repeat_interleave(corner_ids.shape[1])[inside])
        counts.index_add_(0, ids, torch.ones_like(ids))

    def fill(self, rows: torch.Tensor, values: torch.Tensor, shift: torch.Tensor) -> torch.Tensor:
        """The values with the map's, moved by `shift` float32 [V] at its vertices, where they are NaN."""
        unknown = _places(values.isnan())
        points = self._points(rows, unknown)
        distance, known = self._distances(points)
        corner_ids, local, _ = self._scene.volume.lookup(points)
        moved = distance + ops.trilinear_interpolate(shift[:, None], corner_ids, local)[:, 0]
        filled = values.clone()
        filled[unknown] = torch.where(known, moved, torch.nan)
        return filled

    def _points(self, rows: torch.Tensor, places: tuple[torch.Tensor, torch.Tensor]) -> torch.Tensor:
        """World points float32 [N, 3] of voxels: places among the rows, and in the blocks."""
        block, voxel = places
        return (self._volume.block_coords[rows[block]] * BLOCK_SIDE + self._offsets[voxel]).float() * (
            self._volume.voxel_size
        )

    def _distances(self, points: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        values, known = self._scene.sdf(points)
        return values * self._scene.settings.truncation_m, known


def _places(mask: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Rows and columns, int64 [N] each, where a mask is set; as an index they are faster than the mask."""
    rows, columns = mask.nonzero().unbind(1)
    return rows, columns
