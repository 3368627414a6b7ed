"""The system's whole state, as one explicit object that can be checkpointed."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import torch

from spslam import ops
from spslam.camera import Camera
from spslam.config import Config
from spslam.geometry import pose7_to_matrix
from spslam.scene import Scene, SceneSettings
from spslam.scene.sparse_volume import SparseVolume, resize_rows
from spslam.slam.depth_history import DepthHistory
from spslam.slam.depth_keyframes import DepthKeyframeStore
from spslam.slam.feature_store import FeatureStore, uses_features
from spslam.slam.frame_table import FrameTable
from spslam.slam.graph.keyframe import KeyframeCamera
from spslam.slam.graph.keyframe_store import KeyframeStore
from spslam.slam.newest_frame import NewestFrame
from spslam.slam.pixel_database import PixelDatabase
from spslam.slam.sensor_noise import SensorNoiseEstimate

_COLOR = ("texels", "color_decoder")  # names of moments


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


def keeps_moments(config: Config, name: str) -> bool:
    """Whether the moments of a parameter outlast the mapping call that made them."""
    mapping = config.mapping
    return not mapping.reset_moments or (mapping.keep_color_moments and name in _COLOR)


@dataclass
class Segment:
    """A map that was begun while the camera is lost; see `spslam.slam.segments`.

    Attributes:
        first: number of the frame that is its first one.
        state: of its system. Every frame from `first` on is one of its frames too.
        before: how many lost frames its system has before that one: all `first` of them where it may take the place of
            the other map, so that frames have the same numbers in both; none elsewhere.
    """

    first: int
    state: SlamState
    before: int = 0

    def number(self, row: int) -> int:
        """Number of the frame that is in a row of its own."""
        return self.first - self.before + row


@dataclass(frozen=True)
class UnjoinedFrames:
    """Frames of a segment of which it is not known where it lies.

    Attributes:
        rows: int64 [F] numbers of the frames.
        poses: float32 [F, 7] in the axes of the first of them, on the CPU.
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
        depth_history: coarse depth of some of the last frames; None where nothing that moves is looked for.
        features: image features of some earlier frames; none where tracking does not use them.
        newest: the last frame with a trusted pose, for its image features; None where tracking does not use them.
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
    depth_history: DepthHistory | None = None
    features: FeatureStore = field(default_factory=FeatureStore)
    newest: NewestFrame | None = None
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
        return torch.from_numpy(self.pixels.pixel_flags & ~self.frames.lost_flags)

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
        depth_history = DepthHistory(camera, device) if tracking.moving_objects and tracking.depth_keyframes else None
        noise = SensorNoiseEstimate(camera, tracking.depth_noise_m, device)
        graph = None
        if config.graph.enabled and config.prior.enabled:
            prior = config.prior
            graph = KeyframeStore(KeyframeCamera.of(camera, depth_m, prior.normal_step_px, prior.max_jump))
        newest = NewestFrame(camera, depth_m, device) if uses_features(config) else None
        return cls(scene, frames, pixels, noise, depth_keyframes, depth_history, newest=newest, graph=graph)

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
        margin = np.array([[-1], [1]], np.float32) * np.float32(self.scene.settings.truncation_m)
        moved = self.scene.planes.cover(torch.from_numpy(bounds.numpy() + margin))
        if moved is not None and "texels" in self.moments:
            self.moments["texels"].move_rows(moved, len(self.scene.planes.texels))
