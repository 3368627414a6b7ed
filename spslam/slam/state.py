"""The system's whole state, as one explicit object that can be checkpointed."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch

from spslam import ops
from spslam.camera import Camera
from spslam.config import Config
from spslam.datasets.clock import AT_ONCE, CaptureOffsets
from spslam.geometry import pose7_to_matrix
from spslam.scene import Scene, SceneSettings
from spslam.scene.sparse_volume import SparseVolume, resize_rows
from spslam.slam.depth_keyframes import DepthKeyframeStore
from spslam.slam.feature_store import FeatureStore
from spslam.slam.graph.keyframe import KeyframeCamera
from spslam.slam.graph.keyframe_store import KeyframeStore
from spslam.slam.pixel_database import PixelDatabase
from spslam.slam.pixels import THUMBNAIL_STEP_PX
from spslam.slam.sensor_noise import SensorNoiseEstimate

_FIRST_CAPACITY = 64


class FrameTable:
    """What is kept of every processed frame; rows are frames.

    The columns are views of buffers that double when they are full: to write to one changes the table, and a frame
    costs the same after ten thousand others as at first.

    Attributes:
        camera: of all frames.
        opened: how many rows at the begin came with an opened map: its keyframes.
    """

    def __init__(self, camera: Camera, device: torch.device | str = "cpu"):
        """A table without rows for images of that camera."""
        offset = THUMBNAIL_STEP_PX // 2
        rows = len(range(offset, camera.height, THUMBNAIL_STEP_PX))
        columns = len(range(offset, camera.width, THUMBNAIL_STEP_PX))
        self.camera = camera
        self.opened = 0
        self._count = 0
        self._columns = {
            "poses": torch.zeros(0, 7, device=device),
            "timestamps": torch.zeros(0, dtype=torch.float64),
            "depth_times": torch.zeros(0, dtype=torch.float64),
            "color_offsets": torch.zeros(0, dtype=torch.float64),
            "indices": torch.zeros(0, dtype=torch.int64),
            "lost": torch.zeros(0, dtype=torch.bool),
            "consistent_frames": torch.zeros(0, dtype=torch.int64),
            "depth_thumbnails": torch.zeros(0, rows, columns, dtype=torch.float16, device=device),
        }

    @property
    def poses(self) -> torch.Tensor:
        """float32 [F, 7] T_world_camera as unit quaternion (w, x, y, z) and translation (m), on the device."""
        return self._columns["poses"][: self._count]

    @property
    def timestamps(self) -> torch.Tensor:
        """float64 [F], s."""
        return self._columns["timestamps"][: self._count]

    @property
    def depth_times(self) -> torch.Tensor:
        """float64 [F] when the depth images were taken, s, as far as stamps tell."""
        return self._columns["depth_times"][: self._count]

    @property
    def color_offsets(self) -> torch.Tensor:
        """float64 [F] from the depth images to the color images, s, as far as stamps tell."""
        return self._columns["color_offsets"][: self._count]

    @property
    def indices(self) -> torch.Tensor:
        """int64 [F] index in the dataset."""
        return self._columns["indices"][: self._count]

    @property
    def lost(self) -> torch.Tensor:
        """bool [F] whether the pose is not to be trusted."""
        return self._columns["lost"][: self._count]

    @property
    def consistent_frames(self) -> torch.Tensor:
        """int64 [F] how many lost frames up to this one had a pose that is likely, and agree with one another."""
        return self._columns["consistent_frames"][: self._count]

    @property
    def depth_thumbnails(self) -> torch.Tensor:
        """float16 [F, h, w] depth thumbnails (m), on the device."""
        return self._columns["depth_thumbnails"][: self._count]

    @property
    def thumbnail_bytes(self) -> int:
        """Bytes of a frame's depth thumbnail."""
        one = self._columns["depth_thumbnails"]
        return one.element_size() * one.shape[1:].numel()

    @property
    def processed(self) -> int:
        """How many frames were processed: all rows but those that came with an opened map."""
        return self._count - self.opened

    @property
    def knows_speed(self) -> bool:
        """Whether the poses of the last two frames are trusted, so that the next one can be predicted from them."""
        return self.processed >= 2 and not bool(self.lost[-2:].any())

    @property
    def is_anywhere(self) -> bool:
        """Whether a map was opened in which no frame was found yet."""
        return self.opened > 0 and bool(self.lost[self.opened :].all())

    def append(
        self,
        pose: torch.Tensor,
        timestamp: float,
        index: int,
        lost: bool,
        depth_thumbnail: torch.Tensor,
        consistent_frames: int = 0,
        offsets: CaptureOffsets = AT_ONCE,
    ) -> None:
        """Adds a row."""
        if self._count == len(self._columns["poses"]):
            capacity = max(2 * self._count, _FIRST_CAPACITY)
            self._columns = {name: _with_capacity(column, capacity) for name, column in self._columns.items()}
        values: dict[str, Any] = {
            "poses": pose,
            "timestamps": timestamp,
            "depth_times": timestamp + offsets.depth,
            "color_offsets": offsets.color,
            "indices": index,
            "lost": lost,
            "consistent_frames": consistent_frames,
            "depth_thumbnails": depth_thumbnail,
        }
        for name, value in values.items():
            self._columns[name][self._count] = value
        self._count += 1

    def matrices(self, first: int = 0) -> np.ndarray:
        """float64 [F, 4, 4] T_world_camera of the rows from `first` on; negative ones count from the end."""
        return pose7_to_matrix(self.poses[first:].cpu().numpy().astype(np.float64))

    def tensors(self) -> dict[str, torch.Tensor]:
        """All columns, where they are; views, so clone what must stay as it is."""
        return {name: column[: self._count] for name, column in self._columns.items()}

    def load_state_dict(self, state: dict[str, torch.Tensor]) -> None:
        """Replaces the content by copies of what `tensors()` returned."""
        self._count = len(state["poses"])
        self._columns = {name: state[name].to(column.device, copy=True) for name, column in self._columns.items()}

    def __len__(self) -> int:
        return self._count


def _with_capacity(column: torch.Tensor, rows: int) -> torch.Tensor:
    """A column with room for so many rows, zero. On the CPU they take memory only once they are written."""
    if column.device.type != "cpu":
        return resize_rows(column, rows)
    grown = torch.from_numpy(np.zeros((rows, *column.shape[1:]), column.numpy().dtype))
    grown[: len(column)] = column
    return grown


@dataclass
class Moments:
    """What Adam keeps beside one parameter tensor [rows, ...]; may have spare rows at the end.

    Attributes:
        first, second: running moments.
        gradient: sums of the current iteration, zero between iterations; see `ops.new_gradient_sums`.
        stamps: int32 [rows], the iteration that last touched a row.
    """

    first: torch.Tensor
    second: torch.Tensor
    gradient: torch.Tensor
    stamps: torch.Tensor

    @classmethod
    def like(cls, parameter: torch.Tensor) -> Moments:
        """Zero moments for a parameter [rows, columns]."""
        return cls.of(torch.zeros_like(parameter), torch.zeros_like(parameter))

    @classmethod
    def of(cls, first: torch.Tensor, second: torch.Tensor) -> Moments:
        """The given moments, between two iterations."""
        stamps = torch.zeros(len(first), dtype=torch.int32, device=first.device)
        return cls(first, second, ops.new_gradient_sums(first), stamps)

    def fit(self, rows: int) -> None:
        """Appends zero rows up to `rows`, with spare capacity so that growth is amortized."""
        if rows <= len(self.stamps):
            return
        capacity = max(rows, len(self.stamps) * 3 // 2)
        for name in ("first", "second", "gradient", "stamps"):
            setattr(self, name, resize_rows(getattr(self, name), capacity))

    def move_rows(self, rows: torch.Tensor, count: int) -> None:
        """Moves row i to row `rows[i]` of `count` rows, the others zero; for a parameter whose rows moved."""
        for name in ("first", "second", "gradient", "stamps"):
            old = getattr(self, name)
            moved = old.new_zeros((count, *old.shape[1:]))
            moved[rows] = old[: len(rows)]
            setattr(self, name, moved)

    def of_table(self, rate: float) -> ops.AdamTable:
        """For a table of which iterations touch some rows."""
        return ops.AdamTable(self.first, self.second, rate, self.gradient, self.stamps)

    def of_tensor(self, rate: float) -> ops.AdamMoments:
        """For parameters that every iteration steps."""
        return ops.AdamMoments(self.first, self.second, rate)

    def reset(self) -> None:
        """Forgets the past steps."""
        self.first.zero_()
        self.second.zero_()


@dataclass
class Segment:
    """A map that was begun while the camera is lost; see `spslam.slam.segments`.

    Attributes:
        first: number of the frame that is its first one.
        state: of its system. Every frame from `first` on is one of its frames too.
    """

    first: int
    state: SlamState


@dataclass(frozen=True)
class UnjoinedFrames:
    """Frames of a segment of which it is not known where it lies.

    Attributes:
        rows: int64 [F] numbers of the frames.
        poses: float32 [F, 7] in the axes of the segment's first frame, on the CPU.
    """

    rows: torch.Tensor
    poses: torch.Tensor


@dataclass
class SlamState:
    """Everything the system knows between two frames.

    Attributes:
        scene: the map.
        frames: poses and bookkeeping of every frame.
        pixels: pixel records of every frame.
        noise: of the sensor.
        depth_keyframes: images of some earlier frames; None where tracking does not use them.
        features: image features of some earlier frames; none where tracking does not use them.
        graph: keyframes and what was measured between them; None where there is no keyframe graph.
        moments: optimizer state by parameter name.
        steps: Adam steps since the moments were last reset.
        stamp: number of mapping iterations ever done; marks rows touched by the current one.
        unmapped: whether frames came since the map was last optimized.
        segment: the map of a lost camera; None where there is none.
        unjoined: frames of segments that ended before it was known where they lie.
    """

    scene: Scene
    frames: FrameTable
    pixels: PixelDatabase
    noise: SensorNoiseEstimate
    depth_keyframes: DepthKeyframeStore | None = None
    features: FeatureStore = field(default_factory=FeatureStore)
    graph: KeyframeStore | None = None
    moments: dict[str, Moments] = field(default_factory=dict)
    steps: int = 0
    stamp: int = 0
    unmapped: bool = False
    segment: Segment | None = None
    unjoined: list[UnjoinedFrames] = field(default_factory=list)

    @property
    def usable(self) -> torch.Tensor:
        """bool [F] on the CPU: frames that mapping may draw from, as they have pixels and a pose to be trusted."""
        return self.pixels.has_pixels & ~self.frames.lost

    @classmethod
    def start(
        cls,
        config: Config,
        camera: Camera,
        first_pose: np.ndarray,
        geometry_decoder: torch.Tensor | None,
        device: torch.device,
    ) -> SlamState:
        """The state before the first frame, which will be at `first_pose` (float64 [4, 4])."""
        settings = SceneSettings(
            voxel_size_m=config.scene.voxel_size_m,
            truncation_m=config.scene.truncation,
            plane_cell_m=config.scene.plane_cell_m,
            position_scale=config.scene.position_scale,
            max_voxels=config.scene.max_voxels,
            max_texels=config.scene.max_texels,
        )
        origin = torch.from_numpy(np.asarray(first_pose)[:3, 3].copy())
        scene = Scene(settings, config.seed, origin, geometry_decoder, device)
        frames, kept = FrameTable(camera, device), config.pixels
        pixels = PixelDatabase(kept.per_frame, kept.budget_mb, device, kept.keyframe_every, frames.thumbnail_bytes)
        tracking, depth_m = config.tracking, config.dataset.max_depth_m
        depth_keyframes = None
        if tracking.depth_keyframes:
            depth_keyframes = DepthKeyframeStore(camera, depth_m, tracking.depth_keyframe_kernel_m, device)
        noise = SensorNoiseEstimate(camera, tracking.depth_noise_m, device)
        graph = None
        if config.graph.enabled and config.prior.enabled:
            prior = config.prior
            graph = KeyframeStore(KeyframeCamera.of(camera, depth_m, prior.normal_step_px, prior.max_jump))
        return cls(scene, frames, pixels, noise, depth_keyframes, graph=graph)

    def has_enough_features(self, number: int) -> bool:
        """Whether features of enough frames are kept that stand close to where frame `number` stands."""
        rows = [*self.features.frames, number]
        poses = pose7_to_matrix(self.frames.poses[rows].cpu().numpy().astype(np.float64))
        return self.features.has_enough(poses[:-1], poses[-1])

    def replace_volume(self, volume: SparseVolume) -> None:
        """Puts another volume in the place of the scene's; the planes stay, and grow to cover it."""
        self.scene.volume = volume
        self.moments.pop("embeddings", None)
        if volume.num_voxels == 0:
            return
        corners = torch.stack([volume.voxel_coords.amin(0), volume.voxel_coords.amax(0)]).cpu()
        self.cover_planes(corners * volume.voxel_size_m)

    def cover_planes(self, bounds: torch.Tensor) -> None:
        """Grows the planes to cover surface within bounds float32 [2, 3], and what optimizes them with them."""
        margin = torch.tensor([[-1.0], [1.0]]) * self.scene.settings.truncation_m
        moved = self.scene.planes.cover(bounds + margin)
        if moved is not None and "texels" in self.moments:
            self.moments["texels"].move_rows(moved, len(self.scene.planes.texels))
