"""The signed distance field on sparse blocks as an object that grows where surface is measured."""

import itertools

import torch

from spslam.ops._checks import check, check_tensor
from spslam.ops._public import public_op
from spslam.ops.depth_planes import DEFAULT_NOISE, PLANE_SIZE, measure_planes
from spslam.ops.hash_table import VoxelHash
from spslam.ops.marching_cubes import marching_cubes
from spslam.ops.scene_view import Intrinsics, check_intrinsics
from spslam.ops.tsdf import (
    BLOCK_SIDE,
    BLOCK_VOXELS,
    COLOR_SIZE,
    missing_blocks,
    tsdf_integrate_,
    tsdf_query,
)

TRUNCATION_VOXELS = 3.0
# Of the truncation, where there is no noise: little of a surface reaches around its edges.
NEAR_SHARE = 2 / 3
# Bytes of a block: distance and weight as float32, color in 4 x 16 bits, coordinates and table.
BLOCK_BYTES = BLOCK_VOXELS * 16 + 100
_MOST_TOUCH_STEP = 3  # px; larger steps miss thin things
_FAR_M = 5.0  # up to which no block is missed between the pixels that are looked at
_MARCHED_BLOCKS = 1 << 14  # at once, when blocks near the surface are looked for


class TsdfVolume:
    """Signed distance, weight and color of voxels near measured surface (Curless and Levoy 1996; Niessner et al. 2013).

    Args:
        voxel_size: m.
        truncation: the largest, of noisy depth, m; three voxels where not given.
        max_blocks: most blocks of 8 x 8 x 8 voxels, 8.3 kB each; None for as many as memory holds.
        device: where it lives.
        near_truncation: of depth without noise, m; two thirds of `truncation` where not given. See `tsdf_integrate_`.

    Raises:
        ValueError: a number out of range.

    Attributes:
        blocks: the `VoxelHash` of block coordinates.
        voxel_size, truncation, near_truncation: m.
        integrated: number of frames added.

    Example:
        >>> volume = TsdfVolume(0.05)
        >>> camera, pose = Intrinsics(8.0, 8.0, 3.5, 3.5), torch.tensor([1.0, 0, 0, 0, 0, 0, 0])
        >>> volume.integrate(torch.full((8, 8), 2.0), pose, camera)
        >>> vertices, faces = volume.extract()
        >>> bool(((vertices[:, 2] - 2).abs() < 1e-4).all())
        True
    """

    @public_op(name="TsdfVolume")
    def __init__(
        self,
        voxel_size: float,
        truncation: float | None = None,
        max_blocks: int | None = None,
        device: torch.device | str = "cpu",
        near_truncation: float | None = None,
    ):
        check(voxel_size > 0, "TsdfVolume", "voxel_size", "be positive", voxel_size)
        self.voxel_size = voxel_size
        self.truncation = TRUNCATION_VOXELS * voxel_size if truncation is None else truncation
        check(self.truncation >= voxel_size, "TsdfVolume", "truncation", "be at least voxel_size", truncation)
        near = NEAR_SHARE * self.truncation if near_truncation is None else near_truncation
        check(0 < near <= self.truncation, "TsdfVolume", "near_truncation", "be positive and at most truncation", near)
        self.near_truncation = near
        self.integrated = 0
        self.blocks = VoxelHash(device=device, max_voxels=max_blocks)
        self._sdf = torch.zeros(0, BLOCK_VOXELS, dtype=torch.float32, device=device)
        self._weights = torch.zeros(0, BLOCK_VOXELS, dtype=torch.float32, device=device)
        self._colors = torch.zeros(0, BLOCK_VOXELS, COLOR_SIZE, dtype=torch.uint16, device=device)

    def __len__(self) -> int:
        return len(self.blocks)

    @property
    def block_coords(self) -> torch.Tensor:
        """int32 [B, 3]; block b fills [b, b + 1] * 8 * voxel_size."""
        return self.blocks.voxel_coords

    @property
    def sdf(self) -> torch.Tensor:
        """float32 [B, 512] mean distance, m."""
        return self._sdf[: len(self)]

    @property
    def weights(self) -> torch.Tensor:
        """float32 [B, 512]."""
        return self._weights[: len(self)]

    @property
    def colors(self) -> torch.Tensor:
        """uint16 [B, 512, 4], see `tsdf_integrate_`."""
        return self._colors[: len(self)]

    @property
    def nbytes(self) -> int:
        """Memory of all buffers."""
        hashed = (self.blocks.hash_keys, self.blocks.hash_values, self.blocks.coords_buffer, self.blocks.corners_buffer)
        return sum(tensor.nbytes for tensor in (self._sdf, self._weights, self._colors, *hashed))

    def field(self) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor]:
        """Table, distances, weights and colors: the first arguments of `tsdf_query` and `tsdf_ray_cast`.

        Raises:
            ValueError: `blocks` has entries that `add_blocks` did not make, for which there is nothing to read.
        """
        fits = len(self) <= len(self._sdf)
        check(fits, "TsdfVolume.field", "blocks", f"be {len(self._sdf)} at most: use add_blocks", len(self))
        return self.blocks.hash_keys, self.blocks.hash_values, self.sdf, self.weights, self.colors

    def add_blocks(self, block_coords: torch.Tensor) -> None:
        """Makes room for blocks, int32 [N, 3], repetitions allowed; nothing is known of them yet.

        Raises:
            VoxelLimitError: more than `max_blocks`. The volume is then as before.
        """
        self.blocks.add(block_coords)
        rows = len(self._sdf)
        if len(self) > rows:
            # By half, not by two: these are the largest buffers there are.
            added = max(len(self) - rows, rows // 2)
            if self.blocks.max_voxels is not None:
                added = min(added, self.blocks.max_voxels - rows)
            self._sdf = _with_rows(self._sdf, added)
            self._weights = _with_rows(self._weights, added)
            self._colors = _with_rows(self._colors, added)

    def integrate(
        self,
        depth: torch.Tensor,
        pose: torch.Tensor,
        intrinsics: Intrinsics,
        color: torch.Tensor | None = None,
        noise: tuple[float, float] = DEFAULT_NOISE,
    ) -> None:
        """Adds a frame: measures its planes, makes room where they lie, and integrates them.

        Args:
            depth: float32 [H, W], m, 0 where unknown.
            pose: float32 [7], T_world_camera.
            intrinsics: px.
            color: uint8 [H, W, 3], or None.
            noise: of the sensor, see `measure_planes` and `tsdf_integrate_`.

        Raises:
            TypeError, ValueError: a tensor of another dtype, shape or device, or a number out of range. The volume is
                then as before.
            VoxelLimitError: more than `max_blocks`. The volume is then as before.
        """
        planes = measure_planes(depth, intrinsics, noise)
        self.integrate_planes(planes, pose, intrinsics, color, noise)

    def integrate_planes(
        self,
        planes: torch.Tensor,
        pose: torch.Tensor,
        intrinsics: Intrinsics,
        color: torch.Tensor | None = None,
        noise: tuple[float, float] = DEFAULT_NOISE,
    ) -> None:
        """Adds a frame whose planes were measured, and perhaps weighted anew.

        Args:
            planes: float32 [H, W, 5], see `measure_planes`.
            pose, intrinsics, color, noise: as of `integrate`.

        Raises:
            TypeError, ValueError, VoxelLimitError: as `integrate`.
        """
        check_tensor("TsdfVolume.integrate_planes", "planes", planes, ("H", "W", PLANE_SIZE), torch.float32)
        if color is not None:  # before blocks are added
            check_tensor("TsdfVolume.integrate", "color", color, (*planes.shape[:2], 3), torch.uint8, like=planes)
        self.make_room(planes, pose, intrinsics, noise)
        arrays = self.block_coords, self._sdf, self._weights, self._colors
        tsdf_integrate_(
            *arrays,
            planes,
            pose,
            intrinsics,
            voxel_size=self.voxel_size,
            truncation=self.truncation,
            near_truncation=self.near_truncation,
            noise=noise,
            color=color,
        )
        self.integrated += 1

    def make_room(
        self,
        planes: torch.Tensor,
        pose: torch.Tensor,
        intrinsics: Intrinsics,
        noise: tuple[float, float] = DEFAULT_NOISE,
    ) -> None:
        """Adds the blocks that a frame's planes touch, of which nothing is known yet. Arguments as `integrate_planes`.

        Raises:
            TypeError, ValueError, VoxelLimitError: as `integrate`.
        """
        name = "TsdfVolume.make_room"
        check_intrinsics(name, intrinsics)
        reach = 0.5 * BLOCK_SIDE * self.voxel_size / _FAR_M * intrinsics[0]
        step = min(max(int(reach), 1), _MOST_TOUCH_STEP)
        sizes = self.voxel_size, self.truncation, noise, step
        table = self.blocks.hash_keys, self.blocks.hash_values
        missing = missing_blocks(name, table, planes, pose, intrinsics, *sizes)
        if len(missing):
            self.add_blocks(missing)

    def query(self, points: torch.Tensor, min_weight: float = 1e-3) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Distance (m), color and whether both are known, at points float32 [N, 3]; see `tsdf_query`."""
        return tsdf_query(*self.field(), points, voxel_size=self.voxel_size, min_weight=min_weight)

    def least_weights(self, min_weight: float, share: float) -> torch.Tensor:
        """The weight, float32 [B], from which a voxel of each block counts as known.

        Args:
            min_weight: at least this.
            share: and this share of the largest weight near the surface in the block and the 26 around it: fringes
                behind edges and other chance measurements have little beside a surface that was seen often.
        """
        close = self.sdf.abs() < 2 * self.voxel_size
        own = (self.weights * close).amax(1) if len(self) else self.weights.new_zeros(0)
        most = own.clone()
        for step in itertools.product((-1, 0, 1), repeat=3):
            rows = self.blocks.find(self.block_coords + torch.tensor(step, dtype=torch.int32, device=own.device)).long()
            most = torch.maximum(most, torch.where(rows >= 0, own[rows.clamp(min=0)], 0.0))
        return (share * most).clamp(min=min_weight)

    def extract(self, min_weight: float = 0.005, share: float = 0.01) -> tuple[torch.Tensor, torch.Tensor]:
        """The surface as a mesh by marching cubes; cubes with an unknown voxel have no faces.

        Args:
            min_weight: voxels of a smaller weight are unknown.
            share: as are those with less than this share of the largest weight nearby, see `least_weights`.

        Returns:
            float32 [K, 3] vertices, m, and int64 [L, 3] faces, counter-clockwise seen from free space.
        """
        known = self.weights >= self.least_weights(min_weight, share)[:, None]
        return march_blocks(self.block_coords, torch.where(known, self.sdf, torch.nan), self.voxel_size)


def march_blocks(
    block_coords: torch.Tensor, values: torch.Tensor, voxel_size: float
) -> tuple[torch.Tensor, torch.Tensor]:
    """The zero level set of values on blocks of voxels, without seams between them.

    Args:
        block_coords: int32 [B, 3], distinct.
        values: float32 [B, 512]; NaN where unknown.
        voxel_size: m.

    Returns:
        Vertices float32 [K, 3], m, and faces int64 [L, 3], see `marching_cubes`.
    """
    check_tensor("march_blocks", "values", values, (len(block_coords), BLOCK_VOXELS), torch.float32)
    kept = _near_surface(block_coords, values)
    side = BLOCK_SIDE + 1
    samples = values.new_full((len(kept), side, side, side), torch.nan)
    samples[:, :-1, :-1, :-1] = values[kept].view(-1, BLOCK_SIDE, BLOCK_SIDE, BLOCK_SIDE)
    # The samples on a block's upper sides are its upper neighbors', where `marching_cubes` takes them from.
    vertices, faces = marching_cubes(block_coords[kept], samples)
    return vertices * (BLOCK_SIDE * voxel_size), faces


def _near_surface(block_coords: torch.Tensor, values: torch.Tensor) -> torch.Tensor:
    """Rows of the blocks that the surface passes through and of their upper neighbors, ascending."""
    if not len(values):
        return torch.zeros(0, dtype=torch.int64, device=values.device)
    parts = values.split(_MARCHED_BLOCKS)
    least = torch.cat([torch.nan_to_num(part, nan=torch.inf).amin(1) for part in parts])
    most = torch.cat([torch.nan_to_num(part, nan=-torch.inf).amax(1) for part in parts])
    table = VoxelHash(len(block_coords), values.device)
    table.build(block_coords.contiguous())
    low, high = least, most
    around = []
    for step in itertools.product((0, 1), repeat=3):
        rows = table.find(block_coords + torch.tensor(step, dtype=torch.int32, device=values.device)).long()
        around.append(rows)
        known = rows.clamp(min=0)
        low = torch.minimum(low, torch.where(rows >= 0, least[known], torch.inf))
        high = torch.maximum(high, torch.where(rows >= 0, most[known], -torch.inf))
    crossed = (low < 0) & (high >= 0)
    kept = torch.zeros(len(values), dtype=torch.bool, device=values.device)
    for rows in around:
        kept[rows[crossed & (rows >= 0)]] = True
    return torch.nonzero(kept)[:, 0]


def _with_rows(table: torch.Tensor, added: int) -> torch.Tensor:
    return torch.cat((table, table.new_zeros((added, *table.shape[1:]))))
