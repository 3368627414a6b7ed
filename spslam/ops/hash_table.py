"""The voxel hash as an object that grows: the table, its coordinates, and the corners of every cell."""

from typing import Literal, overload

import torch

from spslam.ops._checks import FLOATING, INTEGERS, check, check_tensor, flat_rows, rows_shape, unflat_rows
from spslam.ops._public import public_op
from spslam.ops._voxel_queries import as_voxel_coords, vertices_around
from spslam.ops.hash_lookup import LARGEST_REACH, VoxelLookup
from spslam.ops.voxel_hash import (
    absent_voxels,
    new_voxel_hash,
    voxel_hash_build_,
    voxel_hash_find,
    voxel_hash_insert,
    voxel_hash_update_corner_ids,
)

_CORNERS = 8
_NO_VOXEL = -1


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


class VoxelHash(VoxelLookup):
    """A set of V voxel vertices, each with an id that it keeps; tables of features have a row for each id.

    It holds what the functions `voxel_hash_*` work on, and makes room as the set grows: buffers double, so that growth
    is amortized, and a view's memory stays where it is until `capacity` changes. `spslam.scene.SparseVolume` is this
    with embeddings and fusion weights beside it.

    Coordinates are int32 or int64 [N, 3], or with more leading axes, [..., 3]; what is returned per row has the same
    ones. `len(cells)` is V, and `(x, y, z) in cells` says whether that vertex exists.

    Args:
        capacity: vertices to make room for at first; rounded up to a power of two.
        device: where it lives.
        max_voxels: most vertices allowed; None for as many as memory holds.

    Raises:
        ValueError: `capacity` or `max_voxels` below 1.

    Attributes:
        num_voxels: V. An op that enters voxels in the buffers itself, as `encode_frame_` does, leaves it to its caller
            to set.
        max_voxels: as given.
        hash_keys, hash_values: the table, with 2 `capacity` slots.
        coords_buffer: int32 [capacity, 3], the coordinates of all rows, those not yet in use too.
        corners_buffer: int32 [capacity, 8], the corner ids of all rows, -1 in those not yet in use.

    Example:
        >>> cells = VoxelHash()
        >>> cells.insert(torch.cartesian_prod(*[torch.arange(2, dtype=torch.int32)] * 3))
        tensor([0, 1, 2, 3, 4, 5, 6, 7], dtype=torch.int32)
        >>> x = cells.voxel_coords[:, :1].float()
        >>> ids, local = cells.lookup(torch.tensor([[0.01, 0.02, 0.03]]), voxel_size=0.04)
        >>> trilinear_interpolate(x, ids, local)
        tensor([[0.2500]])
    """

    @public_op(name="VoxelHash")
    def __init__(self, capacity: int = 1024, device: torch.device | str = "cpu", max_voxels: int | None = None):
        check(capacity >= 1, "VoxelHash", "capacity", "be at least 1", capacity)
        check(max_voxels is None or max_voxels >= 1, "VoxelHash", "max_voxels", "be at least 1", max_voxels)
        self.num_voxels = 0
        self.max_voxels = max_voxels
        rows = _power_of_two(capacity)
        self.hash_keys, self.hash_values = new_voxel_hash(2 * rows, device)
        self.coords_buffer = torch.zeros((rows, 3), dtype=torch.int32, device=device)
        self.corners_buffer = torch.full((rows, _CORNERS), _NO_VOXEL, dtype=torch.int32, device=device)

    def __len__(self) -> int:
        return self.num_voxels

    def __repr__(self) -> str:
        limit = "" if self.max_voxels is None else f", max_voxels={self.max_voxels}"
        extent = ""
        if self.num_voxels:
            low, high = (part.tolist() for part in torch.aminmax(self.voxel_coords, dim=0))
            extent = f" from {tuple(low)} to {tuple(high)}"
        return (
            f"VoxelHash({self.num_voxels} voxels{extent}, capacity={self.capacity}{limit}, "
            f"device='{self.hash_keys.device}')"
        )

    @property
    def capacity(self) -> int:
        """Vertices there is room for; tables of as many rows stay valid until it changes."""
        return self.coords_buffer.shape[0]

    @property
    def voxel_coords(self) -> torch.Tensor:
        """int32 [V, 3], row i the coordinates of id i."""
        return self.coords_buffer[: self.num_voxels]

    @property
    def corner_ids(self) -> torch.Tensor:
        """int32 [V, 8], the ids of the corners of the cell above each vertex, all -1 where one is missing."""
        return self.corners_buffer[: self.num_voxels]

    @overload
    def insert(self, voxel_coords: torch.Tensor, return_new: Literal[False] = False) -> torch.Tensor: ...

    @overload
    def insert(self, voxel_coords: torch.Tensor, return_new: Literal[True]) -> tuple[torch.Tensor, torch.Tensor]: ...

    def insert(
        self, voxel_coords: torch.Tensor, return_new: bool = False
    ) -> torch.Tensor | tuple[torch.Tensor, torch.Tensor]:
        """Enters the coordinates that are missing.

        Args:
            voxel_coords: int32 or int64 [N, 3] in [-2^20, 2^20 - 1], repetitions allowed; N = 0 changes nothing.
            return_new: whether to return as well which rows were missing.

        Returns:
            voxel_ids int32 [N]. New ids start at `len(self)`, in the order of (x, y, z): the same on every device. With
            `return_new` also bool [N], True in every row of a vertex that did not exist before.

        Raises:
            ValueError, TypeError: another shape, dtype or device.
            VoxelLimitError: more than `max_voxels` would exist. The set is then as before.
            RuntimeError: a coordinate out of range. The set is then as before.
        """
        coords, leading = self._rows("VoxelHash.insert", voxel_coords)
        voxel_ids = self._find(coords)
        missing = voxel_ids < 0
        absent = coords.index_select(0, missing.nonzero()[:, 0])  # by a mask, torch would wake threads for it
        if absent.shape[0]:
            self._enter(absent_voxels("VoxelHash.insert", self.hash_keys, self.hash_values, absent))
            voxel_ids = self._find(coords)
        voxel_ids = unflat_rows(voxel_ids, leading)
        return (voxel_ids, unflat_rows(missing, leading)) if return_new else voxel_ids

    def add(self, voxel_coords: torch.Tensor) -> int:
        """Enters the coordinates that are missing, as `insert`, but does not look up ids.

        Args:
            voxel_coords: int32 or int64 [N, 3] in [-2^20, 2^20 - 1], repetitions allowed.

        Returns:
            How many were missing.

        Raises:
            ValueError, TypeError, VoxelLimitError, RuntimeError: as `insert`.
        """
        coords, _ = self._rows("VoxelHash.add", voxel_coords)
        if not coords.shape[0]:
            return 0
        absent = absent_voxels("VoxelHash.add", self.hash_keys, self.hash_values, coords)
        if absent.shape[0]:
            self._enter(absent)
        return absent.shape[0]

    @public_op(name="VoxelHash.insert_points")
    def insert_points(self, points: torch.Tensor, voxel_size: float, band: float = 0.0) -> torch.Tensor:
        """Enters the vertices that a field around points needs: of every cell within `band` of a point along each axis.

        Args:
            points: float32 or float64 [N, 3], world, meters. Points that are not finite, or whose cells are out of
                range, are left out.
            voxel_size: edge of a voxel, meters.
            band: meters; 0 enters the eight corners of the cells that the points lie in.

        Returns:
            The new ids, int32 [M] in order: `len(self)` before, and so on. Waits for CUDA.

        Raises:
            ValueError, TypeError: a wrong shape, dtype, device, `voxel_size`, or `band` (0 to 64 voxels).
            VoxelLimitError: more than `max_voxels` would exist. The set is then as before.
        """
        name = "VoxelHash.insert_points"
        check_tensor(name, "points", points, rows_shape(points, 3), FLOATING, like=self.hash_keys)
        check(voxel_size > 0, name, "voxel_size", "be positive", voxel_size)
        check(0 <= band <= LARGEST_REACH * voxel_size, name, "band", f"be 0 to {LARGEST_REACH} voxels", band)
        before = self.num_voxels
        self.insert(vertices_around(flat_rows(points.detach()), voxel_size, band))
        return torch.arange(before, self.num_voxels, dtype=torch.int32, device=self.hash_keys.device)

    def keep(self, mask: torch.Tensor) -> torch.Tensor:
        """Keeps the vertices of a mask and removes the others. Ids close up: features become `features[kept]`.

        Args:
            mask: bool [V], by id.

        Returns:
            kept int64 [V'], the old ids of what is left, in order; the new id of each is its place.

        Raises:
            ValueError, TypeError: another shape, dtype or device.
        """
        check_tensor("VoxelHash.keep", "mask", mask, [self.num_voxels], torch.bool, like=self.hash_keys)
        kept = mask.nonzero()[:, 0]
        if kept.shape[0] < self.num_voxels:
            self.build(self.voxel_coords[kept])
        return kept

    def remove(self, voxel_coords: torch.Tensor) -> torch.Tensor:
        """Removes vertices, those that exist of the given ones; returns what `keep` returns.

        Args:
            voxel_coords: int32 or int64 [N, 3].

        Raises:
            ValueError, TypeError: another shape, dtype or device.
        """
        ids = self._find(self._rows("VoxelHash.remove", voxel_coords)[0])
        mask = torch.ones(self.num_voxels, dtype=torch.bool, device=ids.device)
        mask[ids[ids >= 0].long()] = False
        return self.keep(mask)

    def build(self, voxel_coords: torch.Tensor) -> None:
        """Replaces the content, as on loading a map: row i of `voxel_coords` becomes id i.

        Args:
            voxel_coords: int32 or int64 [V, 3] in [-2^20, 2^20 - 1], distinct; V = 0 empties the set.

        Raises:
            ValueError: another shape or device, a coordinate out of range, or one that occurs twice.
            TypeError: another dtype.
            VoxelLimitError: more than `max_voxels`.

        On an error the set is as before.
        """
        check_tensor("VoxelHash.build", "voxel_coords", voxel_coords, ["V", 3], INTEGERS, like=self.hash_keys)
        voxel_coords = as_voxel_coords(voxel_coords).clone()  # they may be rows of the buffer that is cleared
        rows = voxel_coords.shape[0]
        self._check_limit(rows)
        table = new_voxel_hash(2 * max(self.capacity, _power_of_two(rows)), voxel_coords.device)
        voxel_hash_build_(*table, voxel_coords)
        ids = torch.arange(rows, dtype=torch.int32, device=voxel_coords.device)
        distinct = torch.equal(voxel_hash_find(*table, voxel_coords), ids)
        check(distinct, "VoxelHash.build", "voxel_coords", "be distinct", "a repeated row")
        self._clear()
        self.reserve(rows)
        self.hash_keys.copy_(table[0])
        self.hash_values.copy_(table[1])
        self.coords_buffer[:rows] = voxel_coords
        self.num_voxels = rows
        voxel_hash_update_corner_ids(self.hash_keys, self.hash_values, self.voxel_coords, self.corner_ids, 0)

    def to(self, device: torch.device | str) -> "VoxelHash":
        """The set on a device: itself if it is there, else a copy with the same ids."""
        device, here = torch.device(device), self.hash_keys.device
        if device.type == here.type and device.index in (None, here.index):
            return self
        copy = VoxelHash(self.capacity, device, self.max_voxels)
        copy.build(self.voxel_coords.to(device))
        return copy

    def state_dict(self) -> dict[str, torch.Tensor]:
        """What the set is: `voxel_coords` int32 [V, 3], a copy, of which `load_state_dict` makes the table."""
        return {"voxel_coords": self.voxel_coords.clone()}

    def load_state_dict(self, state: dict[str, torch.Tensor]) -> None:
        """Makes the set what it was when `state_dict` was taken, ids included; see `build` for errors.

        Raises:
            ValueError: other entries than `voxel_coords`.
        """
        name = "VoxelHash.load_state_dict"
        check(set(state) == {"voxel_coords"}, name, "state", "have voxel_coords alone", sorted(state))
        coords = state["voxel_coords"]
        check_tensor(name, "voxel_coords", coords, ["V", 3], INTEGERS)
        self.build(coords.to(self.hash_keys.device))

    @public_op(name="VoxelHash.reserve")
    def reserve(self, rows: int) -> None:
        """Makes room for `rows` vertices, the next power of two of them; the ids and their rows stay.

        Raises:
            VoxelLimitError: `rows` is above `max_voxels`.
        """
        self._check_limit(rows)
        if rows <= self.capacity:
            return
        coords, corners = self.voxel_coords, self.corner_ids
        capacity = _power_of_two(rows)
        self.hash_keys, self.hash_values = new_voxel_hash(2 * capacity, coords.device)
        voxel_hash_build_(self.hash_keys, self.hash_values, coords)
        self.coords_buffer = coords.new_zeros((capacity, 3))
        self.corners_buffer = corners.new_full((capacity, _CORNERS), _NO_VOXEL)
        self.voxel_coords[:] = coords
        self.corner_ids[:] = corners

    def _check_limit(self, rows: int) -> None:
        if self.max_voxels is not None and rows > self.max_voxels:
            raise VoxelLimitError(rows, self.max_voxels)

    def _enter(self, new: torch.Tensor) -> None:
        """Gives the next ids to coordinates that are distinct, sorted and absent."""
        first_new = self.num_voxels
        self.reserve(first_new + new.shape[0])
        voxel_hash_insert(self.hash_keys, self.hash_values, new, first_new)
        self.num_voxels = first_new + new.shape[0]
        self.coords_buffer[first_new : self.num_voxels] = new
        voxel_hash_update_corner_ids(self.hash_keys, self.hash_values, self.voxel_coords, self.corner_ids, first_new)

    def _clear(self) -> None:
        self.num_voxels = 0
        self.hash_keys.fill_(-1)
        self.coords_buffer.zero_()
        self.corners_buffer.fill_(_NO_VOXEL)


def _power_of_two(rows: int) -> int:
    return 1 << max(rows - 1, 0).bit_length()
