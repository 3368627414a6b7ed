"""What can be asked of a voxel hash without changing it."""

from collections.abc import Sequence

import torch

from spslam.ops._checks import FLOATING, INTEGERS, check, check_tensor, flat_rows, rows_shape, unflat_rows
from spslam.ops._public import public_op
from spslam.ops._voxel_queries import as_voxel_coords, nearest_vertices, neighbor_ids
from spslam.ops.voxel_hash import voxel_hash_find, voxel_hash_lookup

LARGEST_REACH = 64  # voxels: a larger radius has millions of lattice points


class VoxelLookup:
    """The look-ups of a `VoxelHash`, by its table and corner ids."""

    hash_keys: torch.Tensor
    hash_values: torch.Tensor

    @property
    def corner_ids(self) -> torch.Tensor:
        """int32 [V, 8], see `VoxelHash`."""
        raise NotImplementedError

    def __contains__(self, voxel: Sequence[int] | torch.Tensor) -> bool:
        if not isinstance(voxel, tuple | list | torch.Tensor):
            raise TypeError(f"VoxelHash.__contains__: voxel must be (x, y, z), got {type(voxel).__name__}")
        coords = torch.as_tensor(voxel, device=self.hash_keys.device)
        check_tensor("VoxelHash.__contains__", "voxel", coords, [3], INTEGERS)
        return bool(self.find(coords[None])[0] >= 0)

    def find(self, voxel_coords: torch.Tensor) -> torch.Tensor:
        """Ids int32 [N] of coordinates int32 or int64 [N, 3], -1 where absent; see `voxel_hash_find`."""
        coords, leading = self._rows("VoxelHash.find", voxel_coords)
        return unflat_rows(self._find(coords), leading)

    def neighbors(self, voxel_coords: torch.Tensor, offsets: torch.Tensor) -> torch.Tensor:
        """Ids of the vertices at offsets from given ones.

        Args:
            voxel_coords: int32 or int64 [N, 3], in the set or not.
            offsets: int32 or int64 [K, 3].

        Returns:
            voxel_ids int32 [N, K], -1 where absent.

        Raises:
            ValueError, TypeError: another shape, dtype or device.
        """
        coords, leading = self._rows("VoxelHash.neighbors", voxel_coords)
        check_tensor("VoxelHash.neighbors", "offsets", offsets, ["K", 3], INTEGERS, like=self.hash_keys)
        ids = neighbor_ids((self.hash_keys, self.hash_values), coords, as_voxel_coords(offsets))
        return unflat_rows(ids, leading)

    @public_op(name="VoxelHash.within_radius")
    def within_radius(
        self, points: torch.Tensor, voxel_size: float, radius: float
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """The vertices within a radius of points, nearest first.

        Args:
            points: float32 or float64 [N, 3], world, meters; those that are not finite have none.
            voxel_size: edge of a voxel, meters. Vertex (x, y, z) lies at that times (x, y, z).
            radius: meters, up to 64 voxels.

        Returns:
            voxel_ids int32 [N, K] and distances [N, K] in meters, K the most that a point has; -1 and infinity beyond
            its own. Vertices at the same distance are in the order of (x, y, z). Waits for CUDA.

        Raises:
            ValueError, TypeError: another shape, dtype or device; `voxel_size` not positive, `radius` out of range.
        """
        return self._nearest("VoxelHash.within_radius", points, voxel_size, radius, None)

    @public_op(name="VoxelHash.nearest")
    def nearest(
        self, points: torch.Tensor, voxel_size: float, k: int, radius: float
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """The k nearest vertices of points, of those within a radius; as `within_radius`, with K = k."""
        check(1 <= k <= 2**20, "VoxelHash.nearest", "k", "be in [1, 2^20]", k)
        return self._nearest("VoxelHash.nearest", points, voxel_size, radius, k)

    @public_op(name="VoxelHash.lookup")
    def lookup(self, points: torch.Tensor, voxel_size: float) -> tuple[torch.Tensor, torch.Tensor]:
        """Corner ids int32 [N, 8] and local coordinates [N, 3] of points [N, 3] (m); see `voxel_hash_lookup`."""
        check_tensor("VoxelHash.lookup", "points", points, rows_shape(points, 3), FLOATING, like=self.hash_keys)
        check(voxel_size > 0, "VoxelHash.lookup", "voxel_size", "be positive", voxel_size)
        parts = voxel_hash_lookup(self.hash_keys, self.hash_values, self.corner_ids, flat_rows(points), voxel_size)
        return unflat_rows(parts[0], points.shape[:-1]), unflat_rows(parts[1], points.shape[:-1])

    def _rows(self, function: str, voxel_coords: torch.Tensor) -> tuple[torch.Tensor, torch.Size]:
        """Coordinates as int32 [N, 3], and their leading axes."""
        shape = rows_shape(voxel_coords, 3)
        check_tensor(function, "voxel_coords", voxel_coords, shape, INTEGERS, like=self.hash_keys)
        return as_voxel_coords(flat_rows(voxel_coords)), voxel_coords.shape[:-1]

    def _find(self, coords: torch.Tensor) -> torch.Tensor:
        return voxel_hash_find(self.hash_keys, self.hash_values, coords)

    def _nearest(
        self, name: str, points: torch.Tensor, voxel_size: float, radius: float, k: int | None
    ) -> tuple[torch.Tensor, torch.Tensor]:
        check_tensor(name, "points", points, rows_shape(points, 3), FLOATING, like=self.hash_keys)
        check(voxel_size > 0, name, "voxel_size", "be positive", voxel_size)
        check(0 <= radius <= LARGEST_REACH * voxel_size, name, "radius", f"be 0 to {LARGEST_REACH} voxels", radius)
        table = self.hash_keys, self.hash_values
        ids, distances = nearest_vertices(table, flat_rows(points.detach()), voxel_size, radius, k)
        return unflat_rows(ids, points.shape[:-1]), unflat_rows(distances, points.shape[:-1])
