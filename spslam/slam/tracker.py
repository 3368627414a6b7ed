"""Finds the pose of one frame against the frozen map (section III.D)."""

import math
from dataclasses import dataclass, replace

import torch

from spslam import ops
from spslam.camera import Camera
from spslam.config import Config
from spslam.scene import Scene
from spslam.slam.optimization import render_options
from spslam.slam.pixels import FramePixels
from spslam.slam.rescue import EarlierFrame, IcpRescue
from spslam.slam.state import FrameTable

RESCUE_GAIN = 0.02  # of support: less is the chance of another draw, and no other pose


@dataclass(frozen=True)
class TrackingResult:
    """A frame's pose and how well it fits.

    Attributes:
        pose: float32 [7].
        iterations: how many were made.
        residual_cm: weighted root mean squared distance of the pixels to the mapped surface; NaN if not tracked.
        inlier_share: share of pixels that fall on mapped surface; NaN if not tracked.
        lost: whether the pose is not to be trusted.
        support: mean robust weight of all pixels, from 0 (none fits the map) to 1 (all do); NaN where not known.
        rescued: whether the pose comes from a start that ICP found.
    """

    pose: torch.Tensor
    iterations: int
    residual_cm: float
    inlier_share: float
    lost: bool
    support: float = math.nan
    rescued: bool = False


class Tracker:
    """Tracks frames one after another; holds no state of its own but scratch."""

    def __init__(self, config: Config, camera: Camera):
        self.config = config
        self.camera = camera
        self.intrinsics = ops.Intrinsics(camera.fx, camera.fy, camera.cx, camera.cy)
        self._graph = ops.LaunchGraph()

    def predict(self, frames: FrameTable) -> torch.Tensor:
        """Constant-speed prediction of the next pose, float32 [7]; the last pose after one frame only, or loss."""
        if len(frames) < 2 or bool(frames.lost[-2:].any()):
            return frames.poses[-1].clone()
        return ops.predict_pose(frames.poses[-2], frames.poses[-1])

    def track(
        self,
        scene: Scene,
        pixels: FramePixels,
        start: torch.Tensor,
        frame: int,
        earlier: EarlierFrame | None = None,
    ) -> TrackingResult:
        """Optimises the pose from `start`; where that fits badly, tries again from where ICP leads.

        Args:
            scene: the map, not changed.
            pixels: of the frame.
            start: float32 [7].
            frame: number of the frame, keys the random draws.
            earlier: the last frame whose pose is trusted; without it there is no second try.
        """
        if self.is_blind(pixels):
            return TrackingResult(start.clone(), 0, math.nan, math.nan, lost=True)
        if self.config.tracking.optimizer == "adam":
            return self._track_adam(scene, pixels.records, start, frame)
        result = self._track_gauss_newton(scene, pixels.records, start, frame)
        if earlier is None or not self._is_doubtful(result):
            return result
        return self._rescue(scene, pixels, start, frame, earlier, result)

    def is_blind(self, pixels: FramePixels) -> bool:
        """Whether too little of the image has depth to tell a pose from."""
        return len(pixels.records) == 0 or pixels.valid_share < self.config.tracking.min_valid_share

    def _iterations(self, frame: int) -> int:
        tracking = self.config.tracking
        return tracking.first_iterations if frame <= tracking.first_frames else tracking.iterations

    def _track_gauss_newton(
        self, scene: Scene, records: torch.Tensor, start: torch.Tensor, frame: int
    ) -> TrackingResult:
        tracking = self.config.tracking
        pose, stats, _ = ops.track_gauss_newton(
            scene.view(),
            records,
            start,
            self.intrinsics,
            num_pixels=tracking.pixels,
            iterations=self._iterations(frame),
            truncation=scene.settings.truncation_m,
            kernel_start=tracking.kernel_start_m,
            kernel_end=tracking.kernel_end_m,
            damping=tracking.damping,
            seed=self.config.seed,
            stream=ops.Stream.TRACKING_PIXELS,
            frame=frame,
        )
        cost, inlier_share, _, _, support = stats[-1].tolist()  # the frame's one wait for the device
        return self._judged(start, pose, len(stats), cost, inlier_share, support)

    def _is_doubtful(self, result: TrackingResult) -> bool:
        """Whether so little of the frame fits the map that the pose may be a wrong one."""
        return self.config.tracking.rescue and (result.lost or result.support < self.config.tracking.rescue_below)

    def _rescue(
        self,
        scene: Scene,
        pixels: FramePixels,
        start: torch.Tensor,
        frame: int,
        earlier: EarlierFrame,
        first: TrackingResult,
    ) -> TrackingResult:
        """The best supported of the first result and those from ICP's poses, begun at `start` and at the last pose."""
        icp, best = IcpRescue(pixels, earlier, self.camera), first
        iterations = first.iterations
        for guess in (start, earlier.pose):
            again = self._track_gauss_newton(scene, pixels.records, icp.pose(guess), frame)
            iterations += again.iterations
            if self._is_better(again, best):
                best = replace(again, rescued=True)
        pose = start.clone() if best.lost else best.pose
        return replace(best, pose=pose, iterations=iterations)

    def _is_better(self, result: TrackingResult, than: TrackingResult) -> bool:
        """Whether a second result replaces the first; in place of a lost one only what needs no rescue itself."""
        if than.lost:
            return not self._is_doubtful(result)
        return not result.lost and result.support > than.support + RESCUE_GAIN

    def _track_adam(self, scene: Scene, records: torch.Tensor, start: torch.Tensor, frame: int) -> TrackingResult:
        tracking, iterations = self.config.tracking, self._iterations(frame)
        best, _ = ops.track_adam(
            scene.view(),
            records,
            start,
            self.intrinsics,
            render_options(self.config, ops.Stream.TRACKING_RAYS, frame),
            num_pixels=tracking.pixels,
            iterations=iterations,
            rotation_rate=tracking.rotation_rate,
            translation_rate=tracking.translation_rate,
            graph=self._graph,
        )
        # A pose that looks away from the map has no loss either, so its fit to the surface decides.
        _, _, cost, inlier_share = ops.gauss_newton_poses(
            scene.view(),
            records[None, : tracking.pixels],
            best[None],
            self.intrinsics,
            truncation=scene.settings.truncation_m,
            kernel=tracking.kernel_end_m,
        )
        fit = torch.cat([cost, inlier_share]).tolist()
        return self._judged(start, best, iterations, *fit)

    def _judged(
        self,
        start: torch.Tensor,
        pose: torch.Tensor,
        iterations: int,
        cost: float,
        inlier_share: float,
        support: float = math.nan,
    ) -> TrackingResult:
        """The result with `pose`, or with `start` where that is lost; `cost` in m^2. A pose of NaN has no inliers."""
        found = inlier_share >= self.config.tracking.min_inlier_share
        residual_cm = 100 * math.sqrt(max(cost, 0.0))
        return TrackingResult(
            pose if found else start.clone(), iterations, residual_cm, inlier_share, not found, support
        )
