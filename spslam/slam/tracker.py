"""Finds the pose of one frame against the frozen map (section III.D)."""

import math
from dataclasses import dataclass

import numpy as np
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
        residual_cm: weighted root mean squared distance of the pixels to the mapped surface (gauss_newton only).
        inlier_share: share of pixels that fall on mapped surface; 1 where the optimiser does not tell.
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
        before, last = FrameTable.matrices(_tail(frames))
        return pose_tensor(constant_speed(before, last), frames.poses.device)

    def track(self, scene: Scene, pixels: FramePixels, start: torch.Tensor, frame: int) -> TrackingResult:
        """Optimises the pose from `start`.

        Args:
            scene: the map, not changed.
            pixels: of the frame.
            start: float32 [7].
            frame: number of the frame, keys the random draws.
        """
        if len(pixels.records) == 0 or pixels.valid_share < self.config.tracking.min_valid_share:
            return TrackingResult(start.clone(), 0, math.nan, 0.0, lost=True)
        if self.config.tracking.optimizer == "adam":
            return self._track_adam(scene, pixels.records, start, frame)
        return self._track_gauss_newton(scene, pixels.records, start, frame)

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
        lost = not (bool(torch.isfinite(pose).all()) and inlier_share >= tracking.min_inlier_share)
        return TrackingResult(
            start.clone() if lost else pose, len(stats), 100 * math.sqrt(max(cost, 0.0)), inlier_share, lost
        )

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
            adam.step(step.grad_poses, iteration + 1)
        return TrackingResult(best_pose, iterations, math.nan, 1.0, lost=not math.isfinite(best))


def _tail(frames: FrameTable) -> FrameTable:
    """The last two rows."""
    return FrameTable(
        frames.poses[-2:], frames.timestamps[-2:], frames.indices[-2:], frames.lost[-2:], frames.lattices[-2:]
    )


def relative_motion(before: np.ndarray, after: np.ndarray) -> tuple[float, float]:
    """Translation (m) and rotation (rad) between two float64 [4, 4] poses."""
    delta = np.linalg.inv(before) @ after
    cosine = np.clip((np.trace(delta[:3, :3]) - 1) / 2, -1, 1)
    return float(np.linalg.norm(delta[:3, 3])), float(np.arccos(cosine))
