"""Fuses the frames of a sequence, at given poses, into a signed distance field on sparse blocks."""

from __future__ import annotations

import enum
import functools
import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import numpy as np
import torch

from spslam import ops
from spslam.datasets.base import RgbdDataset, RgbdFrame
from spslam.datasets.prefetch import prefetch
from spslam.errors import DatasetError, SpslamError
from spslam.geometry import matrix_to_pose7
from spslam.meshing.blurred_edges import edges_are_blurred, without_blurred_edges
from spslam.meshing.depth_views import DepthViews
from spslam.meshing.extract import CHUNK_POINTS, MAX_SLOPE
from spslam.meshing.flying_pixels import flying_pixels, has_flying_pixels
from spslam.meshing.ray_noise import noise_along_rays
from spslam.meshing.reading import reading_threads
from spslam.meshing.rolling_shutter import FrameReadout
from spslam.meshing.sdf_sampling import near_surface
from spslam.ops.tsdf_volume import BLOCK_BYTES, NEAR_SHARE, TRUNCATION_VOXELS
from spslam.scene import Scene

# Where the blocks do not fit into the memory allowed, all frames are fused again with voxels that much larger.
COARSENING = 1.5
_MOST_ATTEMPTS = 12
# Truncation in deviations of the noise of near depth, and at most; a phone's LiDAR, smoothed at edges, needs so many.
NOISE_DEVIATIONS, MOST_TRUNCATION_M = 9.0, 0.1
# Weight of a pixel on a ramp between two surfaces, where depth was smoothed over edges: what else was seen there counts
# for more, and as `extract_fused_mesh` asks for as large a share of the weight nearby, little of a ramp stays beside
# surface. What lies between may be the floor of a landing, of which a camera sees but its edge.
RAMP_WEIGHT = 0.01
# Depth of what covers pixels that are left out, m: a robot's own arm, of which nothing else is known.
COVERED_M = np.float32(0.01)
# Of a flying pixel, likewise. It is another point in every frame, so that a tenth is enough; with less, landings go.
FLYING_WEIGHT = 0.1


@dataclass(frozen=True)
class FusionOptions:
    """How frames are fused.

    Attributes:
        voxel_size_m: edge length of a voxel, m.
        max_memory_mb: of the voxels; larger voxels are taken where they would need more.
        noise: floor (m^2) and growth (1/m^2) of the variance of depth, as of `ops.measure_planes`.
        color_every: voxels take the colors of every so many-th frame, of all others depth alone is read.
    """

    voxel_size_m: float
    max_memory_mb: int
    noise: tuple[float, float]
    color_every: int = 1

    def truncation_m(self, voxel_size_m: float) -> float:
        """Three voxels, or more where all depth is noisy: what lies farther off must not be taken for free space."""
        return max(TRUNCATION_VOXELS * voxel_size_m, self._noise_reach_m)

    def near_truncation_m(self, voxel_size_m: float) -> float:
        """Of depth whose noise does not grow, m."""
        return max(NEAR_SHARE * TRUNCATION_VOXELS * voxel_size_m, self._noise_reach_m)

    @property
    def _noise_reach_m(self) -> float:
        return min(NOISE_DEVIATIONS * math.sqrt(self.noise[0]), MOST_TRUNCATION_M)

    @property
    def max_blocks(self) -> int:
        """The blocks that fit into the memory."""
        return max(self.max_memory_mb * 2**20 // BLOCK_BYTES, 1)


@dataclass(frozen=True)
class PosedFrames:
    """The frames of a dataset that have a pose.

    Attributes:
        dataset: where they are read from.
        indices: int64 [F] of the frames in the dataset.
        poses: float64 [F, 4, 4] T_world_camera, finite.
        noise: of their depth, see `FusionOptions`; None is that of the fusion.
        readout: by which frames of a rolling shutter are rectified; None where they are of one moment each.
    """

    dataset: RgbdDataset
    indices: np.ndarray
    poses: np.ndarray
    noise: tuple[float, float] | None = None
    readout: FrameReadout | None = None

    def __len__(self) -> int:
        return len(self.indices)

    def __getitem__(self, position: int) -> RgbdFrame:
        index = int(self.indices[position])
        frame = self.dataset[index]
        return frame if self.readout is None else self.readout.rectified(index, frame, self.dataset.camera)

    def depth(self, position: int) -> np.ndarray:
        """Float32 [H, W], m: of the frame alone, which takes less time."""
        index = int(self.indices[position])
        depth = self.dataset.depth(index)
        return depth if self.readout is None else self.readout.rectified_depth(index, depth, self.dataset.camera)

    def covered(self, frame: RgbdFrame) -> RgbdFrame:
        """One of the frames for what takes its colors: in pixels that are left out something lies before all else."""
        left_out = self.dataset.left_out
        if left_out is None:
            return frame
        return replace(frame, depth=np.where(left_out, COVERED_M, frame.depth))

    def read(self) -> Iterator[tuple[int, RgbdFrame]]:
        """Positions and frames in order, read ahead by threads; frames that can't be read are left out."""
        with prefetch(self, *reading_threads(self.dataset.readers)) as frames:
            for position, frame in enumerate(frames):
                if not isinstance(frame, DatasetError):
                    yield position, frame


class _EdgeKind(enum.Enum):
    """What lies between two surfaces in the depth images of a recording: nothing, flying pixels, or a ramp."""

    SHARP, FLYING, BLURRED = range(3)

    @staticmethod
    def of(part: PosedFrames, noise: tuple[float, float]) -> _EdgeKind:
        """Judged by a few frames."""
        depths = _DepthImages(part)
        if edges_are_blurred(depths, noise):
            return _EdgeKind.BLURRED
        return _EdgeKind.FLYING if has_flying_pixels(depths, noise) else _EdgeKind.SHARP


@dataclass(frozen=True)
class _DepthImages:
    """The depth images of frames; what was read is kept."""

    part: PosedFrames
    kept: dict[int, np.ndarray] = field(default_factory=dict)

    def __len__(self) -> int:
        return len(self.part)

    def __getitem__(self, position: int) -> np.ndarray:
        depth = self.kept.get(position)
        if depth is None:
            depth = self.kept[position] = self.part.depth(position)
        return depth


def fuse_frames(
    frames: PosedFrames | Sequence[PosedFrames],
    options: FusionOptions,
    scene: Scene | None = None,
    device: torch.device | str = "cpu",
    views: DepthViews | None = None,
) -> ops.TsdfVolume:
    """Fuses all frames into a new volume.

    Where a sensor mixes near and far surface at edges, or smooths depth over them, the pixels between two surfaces have
    little weight. Frames of smoothed depth are read twice: what frames saw before may be free of what a later one takes
    for surface there. How far before and behind a surface voxels learn of it follows from the noise along rays, which
    some pairs of frames show; see `ray_noise.noise_along_rays`.

    Args:
        frames: to be fused, in order; of one dataset or of several in one world.
        options: how.
        scene: a map of the same frames. Blocks are then also made around its surface, so that the frames carve what is
            free of it.
        device: where the volume is.
        views: of the same frames; they are shown those that they want.

    Returns:
        The volume. Its voxel size is the one wanted or, where `max_memory_mb` does not hold that many, a larger one.
        The same frames and options give the same bytes.

    Raises:
        SpslamError: voxels of over a hundred times the size would not fit either. Where the map tells, no frame is read
            for that, and the error names a size that fits.
    """
    cells = None if scene is None else surface_cells(scene)
    least_m = 0.0 if scene is None or cells is None else _least_voxel_m(len(cells), scene, options.max_blocks)
    if options.voxel_size_m * COARSENING ** (_MOST_ATTEMPTS - 1) < least_m:
        raise SpslamError(
            f"voxels of {options.voxel_size_m:g} m need far more than {options.max_memory_mb} MB: choose a resolution "
            f"of at least {least_m:.2g} m (mesh.resolution_m, --resolution), or allow more by mesh.max_memory_mb"
        )
    parts = [frames] if isinstance(frames, PosedFrames) else frames
    noises = [part.noise or options.noise for part in parts]
    befores = np.cumsum([0, *map(len, parts)])  # frames of the parts before each
    device = torch.device(device)
    images: list[_EdgeImages] = []
    for part, noise, before in zip(parts, noises, befores, strict=False):
        colored = np.arange(before, before + len(part)) % options.color_every == 0
        images.append(_EdgeImages(part, noise, _EdgeKind.of(part, noise), colored, device))
    along_rays = [noise_along_rays(part, noise) for part, noise in zip(parts, noises, strict=True)]
    voxel_size_m = options.voxel_size_m
    for _ in range(_MOST_ATTEMPTS):
        if voxel_size_m < least_m:
            voxel_size_m *= COARSENING
            continue
        truncations = options.truncation_m(voxel_size_m), options.near_truncation_m(voxel_size_m)
        volume = ops.TsdfVolume(voxel_size_m, truncations[0], options.max_blocks, device, truncations[1])
        try:
            if scene is not None and cells is not None:
                volume.add_blocks(_blocks_of_cells(cells, scene.volume.voxel_size_m, volume))
            for number, (each, noise) in enumerate(zip(images, along_rays, strict=True)):
                show = None if views is None else functools.partial(views.show, number)
                _fuse_part(volume, each, noise, show)
            return volume
        except ops.VoxelLimitError:
            del volume
            voxel_size_m *= COARSENING
    tried_m = voxel_size_m / COARSENING
    raise SpslamError(
        f"the frames' surface must fit into {options.max_memory_mb} MB with voxels of {tried_m:.3g} m, but does "
        "not; choose a larger resolution (mesh.resolution_m, --resolution), or mesh.max_memory_mb allows more"
    )


def _least_voxel_m(cells: int, scene: Scene, max_blocks: int) -> float:
    """Edge of a voxel, m, below which the blocks of so many cells of a map are surely more than `max_blocks`.

    The points of `_blocks_of_cells` fall into a block for each of its steps per axis, of which a cell shares one with
    the next. So no memory is taken, and no frame read, for what can't fit.
    """
    if not cells:
        return 0.0
    steps = (max_blocks / cells) ** (1 / 3) + 1
    # They are rounded to a whole number.
    return scene.volume.voxel_size_m / (ops.tsdf.BLOCK_SIDE * (steps + 0.5))


def _blocks_of_cells(cells: torch.Tensor, size_m: float, volume: ops.TsdfVolume) -> torch.Tensor:
    """Coordinates int32 [N, 3] of the volume's blocks that cells of a map lie in, with repetitions."""
    steps = max(round(size_m / (ops.tsdf.BLOCK_SIDE * volume.voxel_size)), 1)
    offsets = torch.cartesian_prod(*[torch.linspace(0, 1, steps + 1, device=cells.device)] * 3)
    block_m = ops.tsdf.BLOCK_SIDE * volume.voxel_size
    blocks = [cells.new_zeros(0, 3)]
    for chunk in cells.split(max(CHUNK_POINTS // len(offsets), 1)):
        points = (chunk[:, None] + offsets).reshape(-1, 3) * size_m
        blocks.append((points / block_m).floor().to(torch.int32))
    return torch.cat(blocks).to(volume.sdf.device)


def surface_cells(scene: Scene) -> torch.Tensor:
    """int32 [M, 3], the complete cells of a map that its surface may pass through."""
    volume, truncation_m = scene.volume, scene.settings.truncation_m

    def sdf(points: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        values, known = scene.sdf(points)
        return values * truncation_m, known

    cells = volume.voxel_coords[volume.corner_ids[:, 0] >= 0]
    return near_surface(cells, volume.voxel_size_m, sdf, MAX_SLOPE, CHUNK_POINTS)


class _EdgeImage(NamedTuple):
    """A frame, to be uploaded.

    Attributes:
        depth: float32 [H, W], m.
        color: uint8 [H, W, 3]; None where it was not read.
        edges: depth without ramps, float32 [H, W], or which pixels are flying, bool [H, W], or None.
    """

    depth: Any
    color: torch.Tensor | None
    edges: Any


@dataclass(frozen=True)
class _EdgeImages:
    """Frames with what lies between two surfaces in them, found on the threads that read.

    Attributes:
        part: the frames.
        noise: of their depth.
        edges: of what kind they are.
        colored: bool [F], of which the color image is read.
        device: where they are to be uploaded to.
    """

    part: PosedFrames
    noise: tuple[float, float]
    edges: _EdgeKind
    colored: np.ndarray
    device: torch.device

    def __len__(self) -> int:
        return len(self.part)

    def __getitem__(self, position: int) -> _EdgeImage:
        color = edges = None
        if self.colored[position]:
            frame = self.part[position]
            color, depth = frame.color, frame.depth
        else:
            depth = self.part.depth(position)
        if self.edges is _EdgeKind.BLURRED:
            edges = without_blurred_edges(depth, self.noise)
        elif self.edges is _EdgeKind.FLYING:
            edges = flying_pixels(depth, self.noise)
        rest = (None if image is None else to_be_uploaded(image, self.device) for image in (color, edges))
        return _EdgeImage(to_be_uploaded(depth, self.device), *rest)

    @property
    def without_color(self) -> _EdgeImages:
        """The same, of which no color image is read."""
        return replace(self, colored=np.zeros_like(self.colored))

    def read(self) -> Iterator[tuple[int, _EdgeImage]]:
        """Positions and images on the device, in order; frames that can't be read are left out."""
        with prefetch(self, *reading_threads(self.part.dataset.readers)) as images:
            for position, image in enumerate(images):
                if not isinstance(image, DatasetError):
                    parts = (None if part is None else part.to(self.device, non_blocking=True) for part in image)
                    yield position, _EdgeImage(*parts)


def _fuse_part(
    volume: ops.TsdfVolume,
    images: _EdgeImages,
    along_rays: tuple[float, float],
    show: Callable[[int, torch.Tensor], None] | None,
) -> None:
    """Fuses the frames of one dataset, whose depth has this noise along rays, and shows depth to whom it is for."""
    device, intrinsics, noise = volume.sdf.device, frame_intrinsics(images.part), images.noise
    poses = poses7_on(images.part.poses, device)
    is_blurred = images.edges is _EdgeKind.BLURRED
    if is_blurred:
        for position, image in images.without_color.read():
            ramps = _ramps(image.depth, image.edges, intrinsics, noise)
            volume.make_room(ramps, poses[position], intrinsics, along_rays)
    for position, image in images.read():
        # Smoothed depth: neighbors have the same noise.
        depth = image.edges if is_blurred else image.depth
        if show is not None:
            show(position, image.depth)
        planes = ops.measure_planes(depth, intrinsics, noise, shared_noise=is_blurred)
        if is_blurred:
            planes += _ramps(image.depth, depth, intrinsics, noise)
        elif image.edges is not None:
            planes[..., 4][image.edges] *= FLYING_WEIGHT
        volume.integrate_planes(planes, poses[position], intrinsics, image.color, along_rays)


def _ramps(
    depth: torch.Tensor, kept: torch.Tensor, intrinsics: ops.Intrinsics, noise: tuple[float, float]
) -> torch.Tensor:
    """Planes float32 [H, W, 5] of the pixels of a depth image [H, W] (m) that are not `kept`, with little weight."""
    ramps = ops.measure_planes(depth, intrinsics, noise, shared_noise=True)
    ramps[kept > 0] = 0
    ramps[..., 4] *= RAMP_WEIGHT
    return ramps


def frame_intrinsics(part: PosedFrames) -> ops.Intrinsics:
    """The camera of a part's frames."""
    camera = part.dataset.camera
    return ops.Intrinsics(camera.fx, camera.fy, camera.cx, camera.cy)


def on_device(array: np.ndarray, device: torch.device) -> torch.Tensor:
    """An array as a tensor, of the same memory on the CPU where it is contiguous."""
    return to_be_uploaded(array, device).to(device, non_blocking=True)


def to_be_uploaded(array: np.ndarray, device: torch.device) -> torch.Tensor:
    """An array as a tensor on the CPU, from where a copy to the device waits for nothing that this does.

    That is page-locked memory, which torch keeps for the next one; for the CPU it is the same memory.
    """
    tensor = torch.from_numpy(np.ascontiguousarray(array))
    return tensor.pin_memory() if device.type == "cuda" and array.size else tensor


def poses7_on(poses: np.ndarray, device: torch.device) -> torch.Tensor:
    """T_world_camera [F, 4, 4] as float32 [F, 7]: unit quaternions (w, x, y, z) and translations."""
    return torch.from_numpy(matrix_to_pose7(poses)).to(device, torch.float32)
