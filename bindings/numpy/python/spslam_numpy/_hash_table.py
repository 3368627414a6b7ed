"""The voxel hash as an object that grows: `spslam.ops.VoxelHash` for NumPy arrays."""

from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from spslam_numpy._library import kernels

_CORNERS = 8
_NO_VOXEL = -1
_COORD_MIN, _COORD_MAX = -(2**20), 2**20 - 1

Integers = NDArray[np.int32]
F = TypeVar("F", np.float32, np.float64)


class VoxelLimitError(RuntimeError):
    """A `VoxelHash` would hold more voxels than it may.

    Attributes:
        wanted: voxels there would be.
        max_voxels: the most there may be.
    """

    def __init__(self, wanted: int, max_voxels: int):
        super().__init__(f"VoxelHash: voxels must stay within max_voxels = {max_voxels}, got {wanted}")
        self.wanted = wanted
        self.max_voxels = max_voxels


class VoxelHash:
    """A set of V voxel vertices, each with an id that it keeps; tables of features have a row for each id.

    Buffers double as the set grows. Ids, coordinates and rows of corner ids are those of `spslam.ops.VoxelHash`.

    Args:
        capacity: vertices to make room for at first; rounded up to a power of two.
        max_voxels: most vertices allowed; None for as many as memory holds.

    Raises:
        TypeError: `capacity` or `max_voxels` is no integer.
        ValueError: `capacity` or `max_voxels` below 1.

    Attributes:
        num_voxels: V.
        max_voxels: as given.
        hash_keys, hash_values: the table, with 2 `capacity` slots.
        coords_buffer: int32 [capacity, 3], the coordinates of all rows, those not yet in use too.
        corners_buffer: int32 [capacity, 8], the corner ids of all rows, -1 in those not yet in use.

    Example:
        >>> import numpy as np
        >>> cells = VoxelHash()
        >>> cells.insert(np.array([[5, 0, 0], [2, 0, 0], [5, 0, 0]], np.int32)).tolist()
        [1, 0, 1]
        >>> len(cells), cells.voxel_coords.tolist()
        (2, [[2, 0, 0], [5, 0, 0]])
    """

    def __init__(self, capacity: int = 1024, max_voxels: int | None = None):
        _check_count("VoxelHash", "capacity", capacity)
        if max_voxels is not None:
            _check_count("VoxelHash", "max_voxels", max_voxels)
        self.num_voxels: int = 0
        self.max_voxels: int | None = max_voxels
        rows = _power_of_two(capacity)
        self.hash_keys: NDArray[np.int64]
        self.hash_values: Integers
        self.hash_keys, self.hash_values = kernels.new_voxel_hash(2 * rows)
        self.coords_buffer: Integers = np.zeros((rows, 3), np.int32)
        self.corners_buffer: Integers = np.full((rows, _CORNERS), _NO_VOXEL, np.int32)

    def __len__(self) -> int:
        return self.num_voxels

    @property
    def capacity(self) -> int:
        """Vertices there is room for; tables of as many rows stay valid until it changes."""
        return len(self.coords_buffer)

    @property
    def voxel_coords(self) -> Integers:
        """int32 [V, 3], row i the coordinates of id i."""
        return self.coords_buffer[: self.num_voxels]

    @property
    def corner_ids(self) -> Integers:
        """int32 [V, 8], the ids of the corners of the cell above each vertex, all -1 where one is missing."""
        return self.corners_buffer[: self.num_voxels]

    def insert(self, voxel_coords: Integers) -> Integers:
        """Enters the coordinates that are missing.

        Args:
            voxel_coords: int32 [N, 3] in [-2^20, 2^20 - 1], repetitions allowed; N = 0 changes nothing.

        Returns:
            voxel_ids int32 [N]. New ids start at `len(self)`, in the order of (x, y, z).

        Raises:
            ValueError, TypeError: another shape or dtype.
            VoxelLimitError: more than `max_voxels` would exist. The set is then as before.
            RuntimeError: a coordinate out of range. The set is then as before.
        """
        _check_coords("VoxelHash.insert", voxel_coords)
        outside = np.count_nonzero(((voxel_coords < _COORD_MIN) | (voxel_coords > _COORD_MAX)).any(1))
        if outside:
            raise RuntimeError(
                f"VoxelHash.insert: voxel_coords must lie in [-2^20, 2^20 - 1], got {outside} rows outside"
            )
        voxel_ids = self.find(voxel_coords)
        missing = voxel_coords[voxel_ids < 0]
        if len(missing) == 0:
            return voxel_ids
        self._enter(kernels.voxel_hash_absent(self.hash_keys, self.hash_values, missing))
        return self.find(voxel_coords)

    def build(self, voxel_coords: Integers) -> None:
        """Replaces the content: row i of `voxel_coords` becomes id i. On an error the set is as before.

        Args:
            voxel_coords: int32 [V, 3] in [-2^20, 2^20 - 1], distinct; V = 0 empties the set.

        Raises:
            ValueError: another shape, a coordinate out of range, or one that occurs twice.
            TypeError: another dtype.
            VoxelLimitError: more than `max_voxels`.
        """
        _check_coords("VoxelHash.build", voxel_coords)
        rows = len(voxel_coords)
        self._check_limit(rows)
        capacity = max(self.capacity, _power_of_two(rows))
        table = kernels.new_voxel_hash(2 * capacity)
        kernels.voxel_hash_build_(*table, voxel_coords)
        if not np.array_equal(kernels.voxel_hash_find(*table, voxel_coords), np.arange(rows)):
            raise ValueError("VoxelHash.build: voxel_coords must be distinct, got a repeated row")
        self.hash_keys, self.hash_values = table
        self.coords_buffer = np.zeros((capacity, 3), np.int32)
        self.corners_buffer = np.full((capacity, _CORNERS), _NO_VOXEL, np.int32)
        self.coords_buffer[:rows] = voxel_coords
        self.num_voxels = rows
        self._update_corner_ids(0)

    def find(self, voxel_coords: Integers) -> Integers:
        """Ids int32 [N] of coordinates int32 [N, 3], -1 where absent."""
        _check_coords("VoxelHash.find", voxel_coords)
        return kernels.voxel_hash_find(self.hash_keys, self.hash_values, voxel_coords)

    def lookup(self, points: NDArray[F], voxel_size: float) -> tuple[Integers, NDArray[F]]:
        """Corner ids int32 [N, 8] and local coordinates [N, 3] of points [N, 3] (m); see `voxel_hash_lookup`."""
        return kernels.voxel_hash_lookup(self.hash_keys, self.hash_values, self.corner_ids, points, voxel_size)

    def reserve(self, rows: int) -> None:
        """Makes room for `rows` vertices, the next power of two of them; the ids and their rows stay.

        Raises:
            TypeError: `rows` is no integer.
            VoxelLimitError: `rows` is above `max_voxels`.
        """
        _check_count("VoxelHash.reserve", "rows", rows, least=0)
        self._check_limit(rows)
        if rows <= self.capacity:
            return
        coords, corners = self.voxel_coords, self.corner_ids
        capacity = _power_of_two(rows)
        self.hash_keys, self.hash_values = kernels.new_voxel_hash(2 * capacity)
        kernels.voxel_hash_build_(self.hash_keys, self.hash_values, coords)
        self.coords_buffer = np.zeros((capacity, 3), np.int32)
        self.corners_buffer = np.full((capacity, _CORNERS), _NO_VOXEL, np.int32)
        self.voxel_coords[:] = coords
        self.corner_ids[:] = corners

    def _enter(self, new: Integers) -> None:
        """Gives the next ids to coordinates that are distinct, sorted and absent."""
        first_new = self.num_voxels
        self.reserve(first_new + len(new))
        kernels.voxel_hash_insert(self.hash_keys, self.hash_values, new, first_new)
        self.num_voxels = first_new + len(new)
        self.coords_buffer[first_new : self.num_voxels] = new
        self._update_corner_ids(first_new)

    def _update_corner_ids(self, first_new: int) -> None:
        kernels.voxel_hash_update_corner_ids(
            self.hash_keys, self.hash_values, self.voxel_coords, self.corner_ids, first_new
        )

    def _check_limit(self, rows: int) -> None:
        if self.max_voxels is not None and rows > self.max_voxels:
            raise VoxelLimitError(rows, self.max_voxels)


def _check_count(function: str, argument: str, count: int, least: int = 1) -> None:
    if not isinstance(count, int | np.integer):
        raise TypeError(f"{function}: {argument} must be an int, got {type(count).__name__}")
    if count < least:
        raise ValueError(f"{function}: {argument} must be at least {least}, got {count}")


def _check_coords(function: str, coords: Integers) -> None:
    if not isinstance(coords, np.ndarray):
        raise TypeError(f"{function}: voxel_coords must be a numpy.ndarray, got {type(coords).__name__}")
    if coords.ndim != 2 or coords.shape[1] != 3:
        raise ValueError(f"{function}: voxel_coords must have shape [N, 3], got {list(coords.shape)}")
    if coords.dtype != np.int32 or not coords.dtype.isnative:
        raise TypeError(f"{function}: voxel_coords must be int32, got {coords.dtype}")


def _power_of_two(rows: int) -> int:
    return 1 << max(int(rows) - 1, 0).bit_length()
