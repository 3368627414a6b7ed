"""The voxel hash: which voxel vertices exist, their ids, and the eight corners of the cell around a point.

A table is two tensors of `capacity` slots, a power of two, at most half of them used: `hash_keys` (packed coordinates,
-1 is empty) and `hash_values` (ids). Coordinates are packed with 21 bits per axis; ids count up from 0 without gaps.
"""

import torch

from spslam.ops import _library  # noqa: F401
from spslam.ops._autograd import register_gradient
from spslam.ops._checks import FLOATING, check, check_tensor
from spslam.ops._dispatch import call
from spslam.ops._public import public_op
from spslam.ops._vmap import register_rows_vmap

VOXEL_COORD_MIN = -(2**20)
VOXEL_COORD_MAX = 2**20 - 1


@public_op()
def new_voxel_hash(capacity: int, device: torch.device | str = "cpu") -> tuple[torch.Tensor, torch.Tensor]:
    """An empty table.

    Args:
        capacity: slots, a power of two of at least 2; holds half as many voxels.
        device: where it lives.

    Returns:
        hash_keys int64 [capacity], all -1, and hash_values int32 [capacity].

    Raises:
        ValueError: `capacity` is not a power of two.

    Example:
        >>> hash_keys, hash_values = new_voxel_hash(4)
        >>> hash_keys
        tensor([-1, -1, -1, -1])
    """
    check(capacity >= 2 and capacity & (capacity - 1) == 0, "new_voxel_hash", "capacity", "be a power of two", capacity)
    hash_keys = torch.full((capacity,), -1, dtype=torch.int64, device=device)
    return hash_keys, torch.zeros(capacity, dtype=torch.int32, device=device)


def check_table(function: str, hash_keys: torch.Tensor, hash_values: torch.Tensor) -> None:
    check_tensor(function, "hash_keys", hash_keys, ["capacity"], torch.int64)
    capacity = hash_keys.shape[0]
    check(
        capacity >= 2 and capacity & (capacity - 1) == 0,
        function,
        "hash_keys",
        "have a power of two of slots",
        capacity,
    )
    check_tensor(function, "hash_values", hash_values, [capacity], torch.int32, like=hash_keys)


@public_op()
def voxel_hash_absent(hash_keys: torch.Tensor, hash_values: torch.Tensor, voxel_coords: torch.Tensor) -> torch.Tensor:
    """The coordinates that a table lacks, each once: what `voxel_hash_insert` would enter. Waits for CUDA.

    Args:
        hash_keys, hash_values: the table.
        voxel_coords: int32 [N, 3] in [-2^20, 2^20 - 1], repetitions allowed.

    Returns:
        new_voxel_coords int32 [M, 3] in the order of (x, y, z), the same on every device. M = 0 when nothing is new.

    Raises:
        ValueError: wrong shapes or devices.
        TypeError: wrong dtypes.
        RuntimeError: a coordinate out of range.

    Example:
        >>> coords = torch.tensor([[5, 0, 0], [2, 0, 0], [5, 0, 0]], dtype=torch.int32)
        >>> voxel_hash_absent(*new_voxel_hash(2), coords)  # a table for one voxel: they would not fit
        tensor([[2, 0, 0],
                [5, 0, 0]], dtype=torch.int32)
    """
    return absent_voxels("voxel_hash_absent", hash_keys, hash_values, voxel_coords)


def absent_voxels(
    function: str, hash_keys: torch.Tensor, hash_values: torch.Tensor, voxel_coords: torch.Tensor
) -> torch.Tensor:
    """`voxel_hash_absent` on behalf of another function, which its errors name."""
    check_table(function, hash_keys, hash_values)
    check_tensor(function, "voxel_coords", voxel_coords, ["N", 3], torch.int32, like=hash_keys)
    return torch.ops.spslam.voxel_hash_absent(hash_keys, hash_values, voxel_coords, function)


@public_op()
def voxel_hash_insert(
    hash_keys: torch.Tensor, hash_values: torch.Tensor, voxel_coords: torch.Tensor, first_id: int
) -> torch.Tensor:
    """Enters the coordinates that the table lacks, in place.

    New ids are `first_id`, `first_id + 1`, ... in the order of (x, y, z), whatever the order and the repetitions of the
    input: the same on every device and for every thread count. On an error the table is as before. Waits for CUDA.

    Args:
        hash_keys, hash_values: the table, contiguous; changed.
        voxel_coords: int32 [N, 3] in [-2^20, 2^20 - 1], repetitions allowed.
        first_id: voxels in the table so far.

    Returns:
        new_voxel_coords int32 [M, 3]: row i has id `first_id + i`. M = 0 when nothing is new.

    Raises:
        ValueError: wrong shapes or devices, `first_id` negative.
        TypeError: wrong dtypes.
        RuntimeError: a coordinate out of range, the table would become more than half full, or it has more voxels in
            it than `first_id` says and too few empty slots.

    Example:
        >>> hash_keys, hash_values = new_voxel_hash(8)
        >>> coords = torch.tensor([[5, 0, 0], [2, 0, 0], [5, 0, 0]], dtype=torch.int32)
        >>> voxel_hash_insert(hash_keys, hash_values, coords, first_id=0)
        tensor([[2, 0, 0],
                [5, 0, 0]], dtype=torch.int32)
        >>> voxel_hash_find(hash_keys, hash_values, coords)
        tensor([1, 0, 1], dtype=torch.int32)
    """
    check_table("voxel_hash_insert", hash_keys, hash_values)
    check_tensor("voxel_hash_insert", "voxel_coords", voxel_coords, ["N", 3], torch.int32, like=hash_keys)
    check(first_id >= 0, "voxel_hash_insert", "first_id", "be at least 0", first_id)
    return torch.ops.spslam.voxel_hash_insert(hash_keys, hash_values, voxel_coords, first_id)


@public_op()
def voxel_hash_build_(hash_keys: torch.Tensor, hash_values: torch.Tensor, voxel_coords: torch.Tensor) -> None:
    """Empties the table and enters row i of `voxel_coords` with id i: after growth, or on loading a map.

    Args:
        hash_keys, hash_values: the table, contiguous; changed.
        voxel_coords: int32 [V, 3] in [-2^20, 2^20 - 1], without repetitions.

    Raises:
        ValueError: wrong shapes or devices, or a coordinate out of range.
        TypeError: wrong dtypes.
        RuntimeError: more voxels than half the slots.

    Example:
        >>> hash_keys, hash_values = new_voxel_hash(8)
        >>> coords = torch.tensor([[5, 0, 0], [2, 0, 0]], dtype=torch.int32)
        >>> voxel_hash_build_(hash_keys, hash_values, coords)
        >>> voxel_hash_find(hash_keys, hash_values, coords)
        tensor([0, 1], dtype=torch.int32)
    """
    check_table("voxel_hash_build_", hash_keys, hash_values)
    check_tensor("voxel_hash_build_", "voxel_coords", voxel_coords, ["V", 3], torch.int32, like=hash_keys)
    if voxel_coords.numel():
        low, high = (int(bound) for bound in torch.aminmax(voxel_coords))
        in_range = low >= VOXEL_COORD_MIN and high <= VOXEL_COORD_MAX
        check(in_range, "voxel_hash_build_", "voxel_coords", "lie in [-2^20, 2^20 - 1]", f"[{low}, {high}]")
    torch.ops.spslam.voxel_hash_build_(hash_keys, hash_values, voxel_coords)


@public_op()
def voxel_hash_find(hash_keys: torch.Tensor, hash_values: torch.Tensor, voxel_coords: torch.Tensor) -> torch.Tensor:
    """Ids of coordinates.

    Args:
        hash_keys, hash_values: the table.
        voxel_coords: int32 [N, 3].

    Returns:
        voxel_ids int32 [N], -1 where a coordinate is absent or out of range. Exact on every device. N = 0
        gives an empty tensor.

    Raises:
        ValueError: wrong shapes or devices.
        TypeError: wrong dtypes.

    Example:
        >>> voxel_hash_find(*new_voxel_hash(4), torch.zeros(1, 3, dtype=torch.int32))
        tensor([-1], dtype=torch.int32)
    """
    check_table("voxel_hash_find", hash_keys, hash_values)
    check_tensor("voxel_hash_find", "voxel_coords", voxel_coords, ["N", 3], torch.int32, like=hash_keys)
    return torch.ops.spslam.voxel_hash_find(hash_keys, hash_values, voxel_coords)


@public_op()
def voxel_hash_update_corner_ids(
    hash_keys: torch.Tensor,
    hash_values: torch.Tensor,
    voxel_coords: torch.Tensor,
    corner_ids: torch.Tensor,
    first_new: int,
) -> None:
    """Brings the rows of corner ids up to date after an insertion, in place.

    Row v holds the ids of the cell whose lowest corner is vertex v; corner k is at offset (k & 1, k >> 1 & 1,
    k >> 2 & 1). A row is all -1 unless all eight corners exist. Rows of new vertices are written, and of older ones
    those that a new vertex completes; each has one writer, so the result is exact on every device.

    Args:
        hash_keys, hash_values: the table, with all V voxels in it.
        voxel_coords: int32 [V, 3], in the order of the ids. One out of range has no cell: its row is -1.
        corner_ids: int32 [V, 8], contiguous; rows below `first_new` must be up to date with the voxels before.
        first_new: id of the first new voxel. V means there is none: nothing happens.

    Raises:
        ValueError: wrong shapes or devices, or `first_new` outside [0, V].
        TypeError: wrong dtypes.

    Example:
        >>> hash_keys, hash_values = new_voxel_hash(16)
        >>> cube = torch.cartesian_prod(*[torch.arange(2, dtype=torch.int32)] * 3)
        >>> coords = voxel_hash_insert(hash_keys, hash_values, cube, first_id=0)
        >>> corner_ids = torch.full((8, 8), -1, dtype=torch.int32)
        >>> voxel_hash_update_corner_ids(hash_keys, hash_values, coords, corner_ids, first_new=0)
        >>> corner_ids[0].tolist(), corner_ids[1].tolist()
        ([0, 4, 2, 6, 1, 5, 3, 7], [-1, -1, -1, -1, -1, -1, -1, -1])
    """
    name = "voxel_hash_update_corner_ids"
    check_table(name, hash_keys, hash_values)
    check_tensor(name, "voxel_coords", voxel_coords, ["V", 3], torch.int32, like=hash_keys)
    voxels = voxel_coords.shape[0]
    check_tensor(name, "corner_ids", corner_ids, [voxels, 8], torch.int32, like=hash_keys)
    check(0 <= first_new <= voxels, name, "first_new", f"be in [0, {voxels}]", first_new)
    torch.ops.spslam.voxel_hash_update_corner_ids(hash_keys, hash_values, voxel_coords, corner_ids, first_new)


@public_op()
def voxel_hash_lookup(
    hash_keys: torch.Tensor,
    hash_values: torch.Tensor,
    corner_ids: torch.Tensor,
    points: torch.Tensor,
    voxel_size: float,
) -> tuple[torch.Tensor, torch.Tensor]:
    """The cell around each point; one probe per point.

    Args:
        hash_keys, hash_values: the table.
        corner_ids: int32 [V, 8], see `voxel_hash_update_corner_ids`.
        points: float32 or float64 [N, 3], world, meters.
        voxel_size: edge of a voxel, meters.

    Returns:
        cell_corner_ids int32 [N, 8], a row of -1 for points outside the allocated cells (and NaN), and local_coords
        [N, 3] in [0, 1], 0 for those points. Differentiable: local_coords with respect to points, with slope
        1 / voxel_size inside a cell and 0 outside.

    Raises:
        ValueError: wrong shapes or devices, or `voxel_size` not positive.
        TypeError: wrong dtypes.

    Example:
        >>> hash_keys, hash_values = new_voxel_hash(4)
        >>> no_cells = torch.zeros(0, 8, dtype=torch.int32)
        >>> voxel_hash_lookup(hash_keys, hash_values, no_cells, torch.ones(1, 3), voxel_size=0.04)[1]
        tensor([[0., 0., 0.]])
    """
    name = "voxel_hash_lookup"
    check_table(name, hash_keys, hash_values)
    check_tensor(name, "corner_ids", corner_ids, ["V", 8], torch.int32, like=hash_keys)
    check_tensor(name, "points", points, ["N", 3], FLOATING, like=hash_keys)
    check(voxel_size > 0, name, "voxel_size", "be positive", voxel_size)
    # The op returns them the other way round: opcheck sums up the outputs and cannot begin with integers.
    local_coords, rows = call("voxel_hash_lookup", hash_keys, hash_values, corner_ids, points, voxel_size)
    return rows, local_coords


@torch.library.register_fake("spslam::voxel_hash_absent")
def _(hash_keys, hash_values, voxel_coords, function="voxel_hash_absent"):
    return voxel_coords.new_empty((torch.library.get_ctx().new_dynamic_size(), 3))


@torch.library.register_fake("spslam::voxel_hash_insert")
def _(hash_keys, hash_values, voxel_coords, first_id):
    return voxel_coords.new_empty((torch.library.get_ctx().new_dynamic_size(), 3))


@torch.library.register_fake("spslam::voxel_hash_build_")
def _(hash_keys, hash_values, voxel_coords):
    return None


@torch.library.register_fake("spslam::voxel_hash_find")
def _(hash_keys, hash_values, voxel_coords):
    return voxel_coords.new_empty(voxel_coords.shape[0])


@torch.library.register_fake("spslam::voxel_hash_update_corner_ids")
def _(hash_keys, hash_values, voxel_coords, corner_ids, first_new):
    return None


@torch.library.register_fake("spslam::voxel_hash_lookup")
def _(hash_keys, hash_values, corner_ids, points, voxel_size):
    return points.new_empty(points.shape), corner_ids.new_empty((points.shape[0], 8))


def _save_lookup(ctx, inputs, output):
    _, rows = output
    ctx.mark_non_differentiable(rows)
    ctx.save_for_backward(rows)
    ctx.voxel_size = inputs[4]


def _lookup_backward(ctx, grad_local_coords, _grad_rows):
    (rows,) = ctx.saved_tensors
    inside = (rows[:, :1] >= 0).to(grad_local_coords.dtype)
    return None, None, None, grad_local_coords * inside / ctx.voxel_size, None


register_gradient("voxel_hash_lookup", _lookup_backward, _save_lookup)
register_rows_vmap("voxel_hash_find", (2,))
register_rows_vmap("voxel_hash_lookup", (3,))
