"""Fuses the surface points of a frame into a sparse volume in one call: allocates vertices, encodes, fuses."""

from dataclasses import dataclass
from typing import NamedTuple

import torch

from spslam.ops import _library  # noqa: F401
from spslam.ops._checks import check, check_tensor
from spslam.ops._public import changed_in_place, public_op
from spslam.ops.prior_fusion import ENCODER_PARAMETERS, FEATURES


@dataclass(frozen=True)
class VolumeBuffers:
    """The buffers of a sparse volume, with unused rows for new vertices.

    Attributes:
        hash_keys, hash_values: hash table, see `spslam.ops.voxel_hash`.
        voxel_coords: int32 [V, 3].
        corner_ids: int32 [V, 8], -1 in unused rows.
        embeddings: float32 [V, 8], 0 in unused rows.
        weights: float32 [V], 0 in unused rows.
    """

    hash_keys: torch.Tensor
    hash_values: torch.Tensor
    voxel_coords: torch.Tensor
    corner_ids: torch.Tensor
    embeddings: torch.Tensor
    weights: torch.Tensor

    @property
    def rows(self) -> int:
        """V, the number of rows; the hash table must have twice as many slots."""
        return self.weights.shape[0]

    def check(self, function: str) -> None:
        """Raises ValueError or TypeError if the tensors are inconsistent."""
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
    """Settings of the encoding and fusion of a frame.

    Attributes:
        voxel_size: m.
        neighborhood, min_pair_weight: see `encode_points`.
        max_points: only the first `max_points` points with a normal are used.
        min_weight: vertices with a sum of point weights up to this value are left out.
        kappa: sum of point weights that has the fusion weight 1; larger sums have the fusion weight 1 too.
        max_weight: upper limit of the accumulated weight of a vertex.
        fuse_known: also fuse into existing vertices; if false, only new vertices get features.
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
    """Result of `encode_frame_`.

    Attributes:
        new_voxels: number of new vertices needed.
        fits: whether there was room for them; if not, nothing was changed.
        bounds: float32 [2, 3] on the CPU, the smallest and the largest coordinates (m) of all finite points; +infinity
            and -infinity without such a point.
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

    Equivalent to `encode_points`, `voxel_hash_insert`, `voxel_hash_update_corner_ids` and `fuse_prior_` with the weight
    min(w / kappa, 1) for the vertices with a sum of point weights w above `min_weight`, but in one call, which
    synchronizes with CUDA once.

    Args:
        volume: contiguous tensors; changed in place.
        num_voxels: number of vertices in use.
        max_voxels: largest number of vertices, at most the rows of `volume` and half the slots of its hash table.
        points: float32 [N, 3], world, m.
        normals: float32 [N, 3], world, unit, towards the camera; 0 = unknown.
        encoder_params: float32 [5128], see `encode_points`.
        fusion: settings.
        tf32: see `encode_points`.

    Returns:
        See `EncodedFrame`. Vertices, their ids and their weights are the same on every device, because weights are
        summed as integers. Embeddings are the same in every run and for any number of threads. On CUDA a feature that
        is not finite or exceeds 32768 makes all features of the call NaN. N = 0 changes nothing.

    Raises:
        ValueError: wrong shapes or devices, or a number out of range.
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
    bounds = torch.empty(2, 3, dtype=torch.float32, device="cpu")
    tensors = [volume.hash_keys, volume.hash_values, volume.voxel_coords, volume.corner_ids, volume.embeddings]
    # The enums Scalar and Integer in csrc/bindings/prior_fusion.cpp.
    scalars = [fusion.voxel_size, fusion.min_pair_weight, fusion.min_weight, fusion.kappa, fusion.max_weight]
    integers = [num_voxels, max_voxels, fusion.neighborhood, fusion.max_points, int(fusion.fuse_known), int(tf32)]
    new_voxels = torch.ops.spslam.encode_frame_(
        [*tensors, volume.weights], points, normals, encoder_params, scalars, integers, bounds
    )
    changed_in_place(volume.embeddings, volume.weights)
    return EncodedFrame(new_voxels, num_voxels + new_voxels <= max_voxels, bounds)


@torch.library.register_fake("spslam::encode_frame_")
def _(*arguments):
    return 0
