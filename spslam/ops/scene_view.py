"""Input of the fused ops that describes a scene: the tensors of a map, its sizes and the layout of its planes."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import torch

from spslam.ops._checks import check, check_tensor
from spslam.ops.interpolation import check_plane_layout

GEOMETRY_PARAMS = 32 * 12 + 32 * 33 + 33  # of the 11 -> 32 -> 32 -> 1 decoder
COLOR_PARAMS = 32 * 33 + 32 * 33 + 3 * 33  # of the 32 -> 32 -> 32 -> 3 decoder


class Intrinsics(NamedTuple):
    """Focal lengths and principal point of a pinhole camera, px."""

    fx: float
    fy: float
    cx: float
    cy: float


def check_intrinsics(function: str, intrinsics: Sequence[float], argument: str = "intrinsics") -> None:
    """Raises ValueError unless `intrinsics` has four numbers, the first two positive and finite."""
    check(len(intrinsics) == 4, function, argument, "be (fx, fy, cx, cy)", tuple(intrinsics))
    usable = 0 < intrinsics[0] < math.inf and 0 < intrinsics[1] < math.inf
    check(usable, function, argument, "have positive finite focal lengths", tuple(intrinsics))


@dataclass(frozen=True)
class SceneView:
    """Tensors and sizes of a map with V vertices and P texels, all on one device.

    Attributes:
        hash_keys: int64 [capacity] packed voxel coordinates, capacity a power of two.
        hash_values: int32 [capacity] voxel ids.
        corner_ids: int32 [V, 8] ids of the corners of the cell above each vertex, -1 where it is incomplete.
        embeddings: float32 [V, 8].
        geometry_params: float32 [1473] of the decoder (scaled position, embedding) -> SDF / truncation, tanh.
        texels: float32 [P, 32] rows of the three feature planes.
        color_params: float32 [2211] of the decoder tri-plane feature -> RGB, sigmoid.
        voxel_size: m.
        origin: world point (m) that decoder positions are relative to.
        position_scale: scale of positions at the input of the decoder, 1/m.
        plane_cell_size: m.
        plane_layout: 15 ints, (row offset, origin u, origin v, size u, size v) of the xy, xz and yz planes.
    """

    hash_keys: torch.Tensor
    hash_values: torch.Tensor
    corner_ids: torch.Tensor
    embeddings: torch.Tensor
    geometry_params: torch.Tensor
    texels: torch.Tensor
    color_params: torch.Tensor
    voxel_size: float
    origin: Sequence[float]
    position_scale: float
    plane_cell_size: float
    plane_layout: Sequence[int]

    @classmethod
    def empty(cls, voxel_size: float = 0.04, device: torch.device | str = "cpu") -> "SceneView":
        """A scene without voxels and texels, with decoder parameters of 0; use `dataclasses.replace` to set others."""

        def zeros(*shape: int, dtype: torch.dtype = torch.float32) -> torch.Tensor:
            return torch.zeros(shape, dtype=dtype, device=device)

        return cls(
            hash_keys=torch.full((2,), -1, dtype=torch.int64, device=device),
            hash_values=zeros(2, dtype=torch.int32),
            corner_ids=zeros(0, 8, dtype=torch.int32),
            embeddings=zeros(0, 8),
            geometry_params=zeros(GEOMETRY_PARAMS),
            texels=zeros(0, 32),
            color_params=zeros(COLOR_PARAMS),
            voxel_size=voxel_size,
            origin=(0.0, 0.0, 0.0),
            position_scale=0.25,
            plane_cell_size=0.04,
            plane_layout=[0] * 15,
        )

    def check(self, function: str) -> None:
        """Raises TypeError or ValueError, naming `function`, for a wrong tensor or number."""
        keys = self.hash_keys
        check_tensor(function, "hash_keys", keys, ("capacity",), torch.int64)
        capacity = len(keys)
        check(
            capacity > 0 and capacity & (capacity - 1) == 0,
            function,
            "hash_keys",
            "have a power of two elements",
            capacity,
        )
        check_tensor(function, "hash_values", self.hash_values, (capacity,), torch.int32, like=keys)
        check_tensor(function, "embeddings", self.embeddings, ("V", 8), torch.float32, like=keys)
        check_tensor(function, "corner_ids", self.corner_ids, (len(self.embeddings), 8), torch.int32, like=keys)
        check_tensor(function, "geometry_params", self.geometry_params, (GEOMETRY_PARAMS,), torch.float32, like=keys)
        check_tensor(function, "texels", self.texels, ("P", 32), torch.float32, like=keys)
        check_tensor(function, "color_params", self.color_params, (COLOR_PARAMS,), torch.float32, like=keys)
        check(self.voxel_size > 0, function, "voxel_size", "be positive", self.voxel_size)
        check(self.plane_cell_size > 0, function, "plane_cell_size", "be positive", self.plane_cell_size)
        check(len(self.origin) == 3, function, "origin", "have 3 numbers", len(self.origin))
        check_plane_layout(function, self.plane_layout, len(self.texels), "plane_layout")

    def arguments(self) -> tuple[list[torch.Tensor], list[float], list[int]]:
        """The three lists that the schemas of the ops have: tensors, scalars and plane layout."""
        tensors = [
            self.hash_keys,
            self.hash_values,
            self.corner_ids,
            self.embeddings,
            self.geometry_params,
            self.texels,
            self.color_params,
        ]
        scalars = [self.voxel_size, *self.origin, self.position_scale, self.plane_cell_size]
        return tensors, scalars, list(self.plane_layout)
