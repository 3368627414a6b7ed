"""Finds the pose of one frame against the frozen map (section III.D)."""

import math
from dataclasses import dataclass

import torch

from spslam import ops
from spslam.camera import Camera
from spslam.config import Config
from spslam.geometry import constant_speed
from spslam.scene import Scene
from spslam.slam.optimization import PoseAdam, render_options
from spslam.slam.pixels import FramePixels
from spslam.slam.state import FrameTable, pose_tensor


@dataclass(frozen=True)
class TrackingResult:
    """A frame's pose and how well it fits.

    Attributes:
        pose: float32 [7].
        iterations: how many were made.
        residual_cm: weighted root mean squared distance of the pixels to the mapped surface; NaN if not tracked.
        inlier_share: share of pixels that fall on mapped surface; NaN if not tracked.
        lost: whether the pose is not to be trusted.
    """

    pose: torch.Tensor
    iterations: int
    residual_cm: float
    inlier_share: float
    lost: bool


class Tracker:
    """Tracks frames one after another; holds no state of its own."""

    def __init__(self, config: Config, camera: Camera):
        self.config = config
        self.camera = camera
        self.intrinsics = ops.Intrinsics(camera.fx, camera.fy, camera.cx, camera.cy)

    def predict(self, frames: FrameTable) -> torch.Tensor:
        """Constant-speed prediction of the next pose, float32 [7]; the last pose after one frame only, or loss."""
        if len(frames) < 2 or bool(frames.lost[-2:].any()):
            return frames.poses[-1].clone()
        before, last = frames.matrices(-2)
        return pose_tensor(constant_speed(before, last), frames.poses.device)

    def track(self, scene: Scene, pixels: FramePixels, start: torch.Tensor, frame: int) -> TrackingResult:
        """Optimises the pose from `start`.

        Args:
            scene: the map, not changed.
            pixels: of the frame.
            start: float32 [7].
            frame: number of the frame, keys the random draws.
        """
        if self.is_blind(pixels):
            return TrackingResult(start.clone(), 0, math.nan, math.nan, lost=True)
        if self.config.tracking.optimizer == "adam":
            return self._track_adam(scene, pixels.records, start, frame)
        return self._track_gauss_newton(scene, pixels.records, start, frame)

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
        cost, inlier_share = stats[-1, :2].tolist()
        return self._judged(start, pose, len(stats), cost, inlier_share)

    def _track_adam(self, scene: Scene, records: torch.Tensor, start: torch.Tensor, frame: int) -> TrackingResult:
        tracking, seed = self.config.tracking, self.config.seed
        count, device = tracking.pixels, records.device
        pose = start.clone()[None]
        adam = PoseAdam(pose, tracking.rotation_rate, tracking.translation_rate)
        ray_frames = torch.zeros(count, dtype=torch.int32, device=device)
        best, best_pose = math.inf, start
        iterations = self._iterations(frame)
        for iteration in range(iterations):
            draw = ops.sample_indices(seed, ops.Stream.TRACKING_PIXELS, frame, iteration, count, len(records), device)
            step = ops.render_step(
                scene.view(),
                ops.RayBatch(records[draw], ray_frames, pose, self.intrinsics),
                render_options(self.config, ops.Stream.TRACKING_RAYS, frame, iteration),
            )
            loss = float(step.losses[0])
            if loss < best:
                best, best_pose = loss, pose[0].clone()
            if step.grad_poses is not None:
                adam.step(step.grad_poses, iteration + 1)
        # A pose that looks away from the map has no loss either, so its fit to the surface decides.
        _, _, cost, inlier_share = ops.gauss_newton_poses(
            scene.view(),
            records[None, :count],
            best_pose[None],
            self.intrinsics,
            truncation=scene.settings.truncation_m,
            kernel=self.config.tracking.kernel_end_m,
        )
        return self._judged(start, best_pose, iterations, float(cost), float(inlier_share))

    def _judged(
        self, start: torch.Tensor, pose: torch.Tensor, iterations: int, cost: float, inlier_share: float
    ) -> TrackingResult:
        """The result with `pose`, or with `start` where that is lost; `cost` in m^2."""
        found = bool(torch.isfinite(pose).all()) and inlier_share >= self.config.tracking.min_inlier_share
        residual_cm = 100 * math.sqrt(max(cost, 0.0))
        return TrackingResult(pose if found else start.clone(), iterations, residual_cm, inlier_share, not found)
