"""A frame's surface points into a sparse volume in one call: allocate vertices, encode, fuse."""

from dataclasses import dataclass
from typing import NamedTuple

import torch

from spslam.ops import _library  # noqa: F401
from spslam.ops._checks import check, check_tensor
from spslam.ops._public import public_op
from spslam.ops.prior_fusion import ENCODER_PARAMETERS, FEATURES


@dataclass(frozen=True)
class VolumeBuffers:
    """The tensors of a sparse volume, with room for more vertices than it has.

    Attributes:
        hash_keys, hash_values: its table, see `spslam.ops.voxel_hash`.
        voxel_coords: int32 [V, 3].
        corner_ids: int32 [V, 8], -1 in the rows not yet in use.
        embeddings: float32 [V, 8], 0 in the rows not yet in use.
        weights: float32 [V], likewise.
    """

    hash_keys: torch.Tensor
    hash_values: torch.Tensor
    voxel_coords: torch.Tensor
    corner_ids: torch.Tensor
    embeddings: torch.Tensor
    weights: torch.Tensor

    @property
    def rows(self) -> int:
        """V, the vertices that there is room for; the table must have twice as many slots."""
        return self.weights.shape[0]

    def check(self, function: str) -> None:
        """Raises ValueError or TypeError unless the tensors fit each other."""
        check_tensor(function, "hash_keys", self.hash_keys, ["capacity"], torch.int64)
        slots = self.hash_keys.shape[0]
        check(slots >= 2 and slots & (slots - 1) == 0, function, "hash_keys", "have a power of two of slots", slots)
        check_tensor(function, "hash_values", self.hash_values, [slots], torch.int32, like=self.hash_keys)
        check_tensor(function, "weights", self.weights, ["V"], torch.float32, like=self.hash_keys)
        check_tensor(function, "voxel_coords", self.voxel_coords, [self.rows, 3], torch.int32, like=self.hash_keys)
        check_tensor(function, "corner_ids", self.corner_ids, [self.rows, 8], torch.int32, like=self.hash_keys)
        check_tensor(function, "embeddings", self.embeddings, [self.rows, FEATURES], torch.float32, like=self.hash_keys)


@dataclass(frozen=True)
class FrameFusion:
    """How a frame is encoded and fused.

    Attributes:
        voxel_size: m.
        neighborhood, min_pair_weight: see `encode_points`.
        max_points: the first so many points that have a normal are taken.
        min_weight: vertices whose points weigh this much or less in sum are left out.
        kappa: sum of weights that counts as one observation; more counts no more.
        max_weight: cap of a vertex's total weight.
        fuse_known: whether vertices that the volume has already take part; else only new ones are filled.
    """

    voxel_size: float
    neighborhood: int
    min_pair_weight: float
    max_points: int
    min_weight: float
    kappa: float
    max_weight: float
    fuse_known: bool = True

    def check(self, function: str) -> None:
        """Raises ValueError for a number out of range."""
        check(self.voxel_size > 0, function, "voxel_size", "be positive", self.voxel_size)
        check(self.neighborhood in (8, 64), function, "neighborhood", "be 64 or 8", self.neighborhood)
        check(self.min_pair_weight >= 0, function, "min_pair_weight", "be at least 0", self.min_pair_weight)
        check(self.max_points >= 0, function, "max_points", "be at least 0", self.max_points)
        check(self.min_weight >= 0, function, "min_weight", "be at least 0", self.min_weight)
        check(self.kappa > 0, function, "kappa", "be positive", self.kappa)
        check(self.max_weight > 0, function, "max_weight", "be positive", self.max_weight)


class EncodedFrame(NamedTuple):
    """What became of a frame.

    Attributes:
        new_voxels: vertices that the volume lacked.
        fits: whether there was room for them; else nothing was changed.
        bounds: float32 [2, 3] on the CPU, the least and the largest coordinates (m) of all finite points; infinite,
            the first above the second, where there is none.
    """

    new_voxels: int
    fits: bool
    bounds: torch.Tensor


@public_op()
def encode_frame_(
    volume: VolumeBuffers,
    num_voxels: int,
    max_voxels: int,
    points: torch.Tensor,
    normals: torch.Tensor,
    encoder_params: torch.Tensor,
    fusion: FrameFusion,
    tf32: bool = True,
) -> EncodedFrame:
    """Encodes a frame's points and fuses them into the volume, in place; section III.A and equation (1) of SP-SLAM.

    The same as `encode_points`, then `voxel_hash_insert`, `voxel_hash_update_corner_ids` and `fuse_prior_` with the
    share min(w / kappa, 1) for the vertices of weight w above `min_weight`, in one call that waits for CUDA once.

    Args:
        volume: contiguous tensors; changed.
        num_voxels: vertices in use so far.
        max_voxels: the most there may be, at most the rows of `volume` and half the slots of its table.
        points: float32 [N, 3], world, m.
        normals: float32 [N, 3], world, unit, towards the camera; 0 = unknown.
        encoder_params: float32 [5128], see `encode_points`.
        fusion: settings.
        tf32: see `encode_points`.

    Returns:
        See `EncodedFrame`. Vertices, their numbers and their weights are the same on every device, as sums of weights
        are kept in integers; embeddings are the same on every run and for any number of threads. On CUDA a feature that
        is not finite or beyond 32768 makes all features of the call NaN. N = 0 changes nothing.

    Raises:
        ValueError: wrong shapes or devices, a number out of range, `num_voxels` above `max_voxels` or that above the
            room there is.
        TypeError: wrong dtypes.

    Example:
        >>> keys, values = new_voxel_hash(256)
        >>> coords, corners = torch.zeros(128, 3, dtype=torch.int32), torch.full((128, 8), -1, dtype=torch.int32)
        >>> volume = VolumeBuffers(keys, values, coords, corners, torch.zeros(128, 8), torch.zeros(128))
        >>> point, normal = torch.tensor([[0.02, 0.02, 1.02]]), torch.tensor([[0.0, 0.0, -1.0]])
        >>> fusion = FrameFusion(0.04, 8, 0.0, max_points=100, min_weight=0.0, kappa=2.5, max_weight=20.0)
        >>> encode_frame_(volume, 0, 128, point, normal, torch.zeros(5128), fusion).new_voxels
        8
        >>> coords[7].tolist(), corners[0].tolist()
        ([1, 1, 26], [0, 4, 2, 6, 1, 5, 3, 7])
    """
    name = "encode_frame_"
    volume.check(name)
    fusion.check(name)
    room = min(volume.rows, volume.hash_keys.shape[0] // 2)
    check(0 <= max_voxels <= room, name, "max_voxels", f"be in [0, {room}]", max_voxels)
    check(0 <= num_voxels <= max_voxels, name, "num_voxels", f"be in [0, {max_voxels}]", num_voxels)
    check_tensor(name, "points", points, ["N", 3], torch.float32, like=volume.weights)
    check_tensor(name, "normals", normals, [points.shape[0], 3], torch.float32, like=points)
    check_tensor(name, "encoder_params", encoder_params, [ENCODER_PARAMETERS], torch.float32, like=points)
    bounds = torch.empty(2, 3)
    tensors = [volume.hash_keys, volume.hash_values, volume.voxel_coords, volume.corner_ids, volume.embeddings]
    # The enums Scalar and Integer in csrc/bindings/prior_fusion.cpp.
    scalars = [fusion.voxel_size, fusion.min_pair_weight, fusion.min_weight, fusion.kappa, fusion.max_weight]
    integers = [num_voxels, max_voxels, fusion.neighborhood, fusion.max_points, int(fusion.fuse_known), int(tf32)]
    new_voxels = torch.ops.spslam.encode_frame_(
        [*tensors, volume.weights], points, normals, encoder_params, scalars, integers, bounds
    )
    return EncodedFrame(new_voxels, num_voxels + new_voxels <= max_voxels, bounds)


@torch.library.register_fake("spslam::encode_frame_")
def _(*arguments):
    return 0
