"""The voxel hash as an object that grows: the table, its coordinates, and the corners of every cell."""

import torch

from spslam.ops._checks import check
from spslam.ops.voxel_hash import (
    new_voxel_hash,
    voxel_hash_build_,
    voxel_hash_find,
    voxel_hash_insert,
    voxel_hash_lookup,
    voxel_hash_update_corner_ids,
)


class VoxelHash:
    """A set of V voxel vertices, each with an id that it keeps; tables of features have a row for each id.

    It holds what the functions `voxel_hash_*` work on, and makes room as the set grows: buffers double, so that growth
    is amortised. `spslam.scene.SparseVolume` is this with embeddings and fusion weights beside it.

    Args:
        capacity: vertices to make room for at first.
        device: where it lives.

    Raises:
        ValueError: `capacity` below 1.

    Example:
        >>> cells = VoxelHash()
        >>> cells.insert(torch.cartesian_prod(*[torch.arange(2, dtype=torch.int32)] * 3))
        tensor([0, 1, 2, 3, 4, 5, 6, 7], dtype=torch.int32)
        >>> x = cells.voxel_coords[:, :1].float()
        >>> ids, local = cells.lookup(torch.tensor([[0.01, 0.02, 0.03]]), voxel_size=0.04)
        >>> trilinear_interpolate(x, ids, local)
        tensor([[0.2500]])
    """

    def __init__(self, capacity: int = 1024, device: torch.device | str = "cpu"):
        check(capacity >= 1, "VoxelHash", "capacity", "be at least 1", capacity)
        self.num_voxels = 0
        self.hash_keys, self.hash_values = new_voxel_hash(2 * _power_of_two(capacity), device)
        self._voxel_coords = torch.empty((0, 3), dtype=torch.int32, device=device)
        self._corner_ids = torch.empty((0, 8), dtype=torch.int32, device=device)
        self._reserve(_power_of_two(capacity))

    def __len__(self) -> int:
        return self.num_voxels

    @property
    def voxel_coords(self) -> torch.Tensor:
        """int32 [V, 3], row i the coordinates of id i."""
        return self._voxel_coords[: self.num_voxels]

    @property
    def corner_ids(self) -> torch.Tensor:
        """int32 [V, 8], the ids of the corners of the cell above each vertex, all -1 where one is missing."""
        return self._corner_ids[: self.num_voxels]

    def insert(self, voxel_coords: torch.Tensor) -> torch.Tensor:
        """Enters the coordinates that are missing.

        Args:
            voxel_coords: int32 [N, 3] in [-2^20, 2^20 - 1], repetitions allowed; N = 0 changes nothing.

        Returns:
            voxel_ids int32 [N]. New ids go on from `len(self)` in the order of (x, y, z): the same on every device.

        Raises:
            ValueError, TypeError: another shape, dtype or device.
            RuntimeError: a coordinate out of range. The set is then as before.
        """
        voxel_ids = self.find(voxel_coords)
        absent = voxel_coords[voxel_ids < 0]
        if absent.shape[0] == 0:
            return voxel_ids
        self._reserve(self.num_voxels + absent.shape[0])
        new = voxel_hash_insert(self.hash_keys, self.hash_values, absent, self.num_voxels)
        first_new, self.num_voxels = self.num_voxels, self.num_voxels + new.shape[0]
        self._voxel_coords[first_new : self.num_voxels] = new
        voxel_hash_update_corner_ids(self.hash_keys, self.hash_values, self.voxel_coords, self.corner_ids, first_new)
        return self.find(voxel_coords)

    def find(self, voxel_coords: torch.Tensor) -> torch.Tensor:
        """Ids int32 [N] of coordinates int32 [N, 3], -1 where absent; see `voxel_hash_find`."""
        return voxel_hash_find(self.hash_keys, self.hash_values, voxel_coords)

    def lookup(self, points: torch.Tensor, voxel_size: float) -> tuple[torch.Tensor, torch.Tensor]:
        """Corner ids int32 [N, 8] and local coordinates [N, 3] of points [N, 3] (m); see `voxel_hash_lookup`."""
        return voxel_hash_lookup(self.hash_keys, self.hash_values, self.corner_ids, points, voxel_size)

    def _reserve(self, rows: int) -> None:
        if rows <= self._voxel_coords.shape[0]:
            return
        capacity = _power_of_two(rows)
        coords = self._voxel_coords.new_zeros((capacity, 3))
        corners = self._corner_ids.new_full((capacity, 8), -1)
        coords[: self.num_voxels] = self.voxel_coords
        corners[: self.num_voxels] = self.corner_ids
        if 2 * capacity > self.hash_keys.shape[0]:
            self.hash_keys, self.hash_values = new_voxel_hash(2 * capacity, coords.device)
            voxel_hash_build_(self.hash_keys, self.hash_values, coords[: self.num_voxels])
        self._voxel_coords, self._corner_ids = coords, corners


def _power_of_two(rows: int) -> int:
    return 1 << max(rows - 1, 0).bit_length()
