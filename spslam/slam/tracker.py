"""Finds the pose of one frame against the frozen map (section III.D)."""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from enum import IntEnum
from functools import cached_property

import numpy as np
import torch

from spslam import ops
from spslam.camera import Camera
from spslam.config import Config
from spslam.scene import Scene
from spslam.slam.constraints import Constraints
from spslam.slam.fit import FAR_CM, FAR_DEG, Fit, min_eigenvalue, pose_variance, prediction_error
from spslam.slam.frame_table import FrameTable
from spslam.slam.render_options import render_options

# A plain wall's map moves the camera along it by its own noise, by centimeters a frame, before the brightness of depth
# keyframes has a say: directions of less information than this, per pixel and m^2, wait for them.
HELD_INFORMATION = 0.1
# Of the second pass over a frame that was bent, by a pixel or so: it begins where the first one ended.
AGAIN_ITERATIONS = 3


@dataclass(frozen=True)
class TrackingProblem:
    """One frame to be tracked.

    Attributes:
        scene: the map, not changed.
        records: int32 [P, 3] the frame's packed pixels.
        predicted: float32 [7], the pose that the motion model predicts.
        frame: number of the frame; keys the random draws.
        constraints: residual terms in addition to the map's.
    """

    scene: Scene
    records: torch.Tensor
    predicted: torch.Tensor
    frame: int
    constraints: Constraints = Constraints()


@dataclass(frozen=True)
class SurfaceEquations:
    """Normal equations of a pose, by what the map alone says.

    Attributes:
        numbers: 36, the matrix of a step (translation m, rotation rad) by rows.
        pixels: how many it is a sum over.
        variance: of one of them, m^2, were they independent.
    """

    numbers: list[float]
    pixels: int
    variance: float

    @property
    def information(self) -> np.ndarray:
        """float64 [6, 6], inverse covariance of (translation m, rotation rad about the camera's center) in world axes,
        as surface alone determines the pose."""
        return np.array(self.numbers).reshape(6, 6) / self.variance


@dataclass(frozen=True)
class PoseEstimate:
    """A pose that tracking found.

    Attributes:
        pose: float32 [7].
        iterations: how many were made.
        measured: how well it fits, without what is only worked out of a pose that is decided on, see `fit`.
        equations: of surface alone at that pose; None where there are none.
        numbers: of the pose, read with its fit; None where they were not.
        gain: float32 [2] of the frame at that pose, as `FrameTable.gains`; on the device. None without earlier images
            whose exposure is known.
    """

    pose: torch.Tensor
    iterations: int
    measured: Fit
    equations: SurfaceEquations | None
    numbers: tuple[float, ...] | None = None
    gain: torch.Tensor | None = None

    @cached_property
    def fit(self) -> Fit:
        """How well it fits."""
        if self.equations is None:
            return self.measured
        return self.measured.having(min_eigenvalue=min_eigenvalue(self.equations.numbers, self.equations.pixels))


class FrameOutcome(IntEnum):
    """What the first pass says of a frame that is followed: FrameOutcome of csrc/include/spslam/track_frame.h."""

    SETTLED = 0  # its pose stands
    BENT = 1  # the frame was rectified by that, and tracked again
    FAR = 2  # its pose is far from the prediction: the frame is to be tracked on


@dataclass(frozen=True)
class FollowedFrame:
    """A frame of a moving camera that was predicted, rectified and tracked in one call.

    Attributes:
        asked: the frame, as predicted motion rectifies it, without that motion among its constraints.
        motion: that motion.
        outcome: of the first pass.
        estimate: by the last pass.
        first_pose: float32 [7] by the first pass.
        rectified: records, depth and intensity of the frame as the motion to the estimated pose rectifies them.
    """

    asked: TrackingProblem
    motion: ops.ShutterMotion
    outcome: FrameOutcome
    estimate: PoseEstimate
    first_pose: torch.Tensor
    rectified: list[torch.Tensor]

    @cached_property
    def problem(self) -> TrackingProblem:
        """The frame, as predicted motion rectifies it; of most frames nobody asks."""
        return replace(self.asked, constraints=replace(self.asked.constraints, shutter=self.motion))


class Tracker:
    """Tracks one frame at a time; holds no state but scratch. Whether a pose is to be trusted is not decided here.

    Args:
        config: options of the run.
        camera: of all frames.
        score_kernel_m: width of the robust kernel that the fit is measured by, m.
    """

    def __init__(self, config: Config, camera: Camera, score_kernel_m: float):
        self.config = config
        self.intrinsics = ops.Intrinsics(camera.fx, camera.fy, camera.cx, camera.cy)
        self._score_kernel_m = score_kernel_m
        self._graph = ops.LaunchGraph()

    def predict(self, frames: FrameTable, steps: float = 1.0) -> torch.Tensor:
        """The next pose at constant velocity, float32 [7]; the last pose after one frame only, or a lost one.

        `steps` as of `FrameHistory`.
        """
        if not frames.knows_speed:
            return frames.poses[-1].clone()
        poses = frames.poses
        return ops.trusted.predict_pose(poses[-2], poses[-1], steps)

    def track(self, problem: TrackingProblem, meanwhile: Callable[[], None] | None = None) -> PoseEstimate:
        """Optimizes the pose from the predicted one, with the configured optimizer.

        Args:
            problem: the frame.
            meanwhile: called once the device has its work, before its result is waited for.
        """
        tracking = self.config.tracking
        first = problem.frame <= tracking.first_frames
        iterations = tracking.first_iterations if first else tracking.iterations
        if tracking.optimizer == "adam":
            return self._track_adam(problem, iterations, meanwhile)
        found = self._gauss_newton(problem, problem.predicted, iterations, tracking.kernel_start_m, meanwhile)
        return self.track_on(problem, found) if found.measured.is_far_from_prediction else found

    def track_on(self, problem: TrackingProblem, found: PoseEstimate) -> PoseEstimate:
        """Tracks on from a pose far from the prediction, maybe half-way; stays there if that leads off the map."""
        further = self.track_from(problem, found.pose)
        is_on_map = further.measured.inlier_share >= self.config.tracking.min_inlier_share
        return replace(further if is_on_map else found, iterations=found.iterations + further.iterations)

    def can_follow(self, frames: FrameTable) -> bool:
        """Whether `follow` tracks the next frame as `track` does: its speed is known, and it is none of the first."""
        tracking = self.config.tracking
        return tracking.optimizer == "gauss_newton" and frames.knows_speed and len(frames) > tracking.first_frames

    def follow(
        self,
        scene: Scene,
        frame: ops.trusted.MovingFrame,
        bent_turn: float,
        number: int,
        constraints: Constraints,
        meanwhile: Callable[[], None] | None = None,
    ) -> FollowedFrame:
        """Predicts a frame's pose, rectifies it and tracks it, and again where predicted motion has bent it.

        Args:
            scene: the map, not changed.
            frame: as it was read.
            bent_turn: turn from the prediction during the readout, more of which bends the frame, rad.
            number: of the frame; keys the random draws.
            constraints: residual terms in addition to the map's.
            meanwhile: as of `track`.
        """
        tracking = self.config.tracking
        found, *outputs = ops.trusted.track_frame(
            scene.view(),
            frame,
            (bent_turn, FAR_CM / 100, math.radians(FAR_DEG)),
            AGAIN_ITERATIONS,
            self.intrinsics,
            self._options(scene, number, tracking.iterations, tracking.kernel_start_m),
            constraints.noise,
            constraints.reference,
            constraints.depth_keyframes_of(tracking.iterations),
        )
        if meanwhile is not None:
            meanwhile()
        parts = ops.trusted.followed_parts(found, AGAIN_ITERATIONS)
        numbers = found.tolist()
        outcome = FrameOutcome(int(numbers[0]))
        iterations = tracking.iterations + (AGAIN_ITERATIONS if outcome == FrameOutcome.BENT else 0)
        last = numbers[-parts.last_size :]
        gain = parts.gain if constraints.tells_gain else None
        estimate = self._estimate(parts.pose, gain, last, numbers[1:8], iterations)
        motion = ops.ShutterMotion(frame.poses[1], parts.predicted, frame.seconds, parts.readout)
        problem = TrackingProblem(scene, outputs[0], parts.predicted, number, constraints)
        return FollowedFrame(problem, motion, outcome, estimate, parts.first_pose, outputs[1:])

    def track_from(self, problem: TrackingProblem, start: torch.Tensor) -> PoseEstimate:
        """Optimizes the pose from another initial pose, float32 [7], by Gauss-Newton."""
        tracking = self.config.tracking
        return self._gauss_newton(problem, start, tracking.iterations, tracking.kernel_start_m)

    def track_again(self, problem: TrackingProblem, start: torch.Tensor) -> PoseEstimate:
        """The pose of a frame that was rectified anew, near the pose float32 [7] that this is by."""
        constraints = replace(problem.constraints, keyframes_from_start=True)
        kernel_m = self.config.tracking.kernel_end_m
        return self._gauss_newton(replace(problem, constraints=constraints), start, AGAIN_ITERATIONS, kernel_m)

    def _track_adam(
        self, problem: TrackingProblem, iterations: int, meanwhile: Callable[[], None] | None
    ) -> PoseEstimate:
        tracking = self.config.tracking
        best, _ = ops.track_adam(
            problem.scene.view(),
            problem.records,
            problem.predicted,
            self.intrinsics,
            render_options(self.config, ops.RandomStream.TRACKING_RAYS, problem.frame),
            num_pixels=tracking.pixels,
            iterations=iterations,
            rotation_rate=tracking.rotation_rate,
            translation_rate=tracking.translation_rate,
            graph=self._graph,
        )
        # A pose that looks away from the map has no loss either, so its fit to the surface is measured all the same.
        return replace(self.measure(problem, best, meanwhile), iterations=iterations)

    def measure(
        self, problem: TrackingProblem, pose: torch.Tensor, meanwhile: Callable[[], None] | None = None
    ) -> PoseEstimate:
        """How well a given pose float32 [7] fits; `meanwhile` as of `track`."""
        estimate = self._gauss_newton(problem, pose, 1, self.config.tracking.kernel_end_m, meanwhile, stays=True)
        return replace(estimate, pose=pose, iterations=0, numbers=None)

    def _gauss_newton(
        self,
        problem: TrackingProblem,
        start: torch.Tensor,
        iterations: int,
        kernel_start_m: float,
        meanwhile: Callable[[], None] | None = None,
        stays: bool = False,
    ) -> PoseEstimate:
        """Optimizes the pose from an initial one; with `stays` it is that pose whose prediction error is told."""
        found = ops.trusted.track_gauss_newton(
            problem.scene.view(),
            problem.records,
            start,
            self.intrinsics,
            self._options(problem.scene, problem.frame, iterations, kernel_start_m),
            problem.constraints.noise,
            problem.constraints.reference,
            problem.constraints.depth_keyframes_of(iterations),
        )
        if meanwhile is not None:
            meanwhile()
        # Waits for the device, once: whether the pose is trusted decides what is done next.
        is_predicted = start is problem.predicted
        numbers = (found if is_predicted else torch.cat([found, problem.predicted])).tolist()
        size = found.numel()
        predicted = numbers[:7] if is_predicted else numbers[size:]
        gain = found[-2:] if problem.constraints.tells_gain else None
        estimate = self._estimate(found[7:14], gain, numbers[7:size], predicted, iterations)
        if not stays:
            return estimate
        error_cm, error_deg = prediction_error(predicted, numbers[:7])
        fit = estimate.measured.having(prediction_error_cm=error_cm, prediction_error_deg=error_deg)
        return replace(estimate, measured=fit)

    def _options(self, scene: Scene, number: int, iterations: int, kernel_start_m: float) -> ops.GaussNewtonOptions:
        tracking = self.config.tracking
        return ops.GaussNewtonOptions(
            num_pixels=tracking.pixels,
            iterations=iterations,
            truncation=scene.settings.truncation_m,
            kernel_start=kernel_start_m,
            kernel_end=tracking.kernel_end_m,
            damping=tracking.damping,
            seed=self.config.seed,
            stream=ops.RandomStream.TRACKING_PIXELS,
            frame=number,
            score_kernel=self._score_kernel_m,
            held_information=HELD_INFORMATION,
            tf32=self.config.precision == "tf32",
        )

    def _estimate(
        self,
        found: torch.Tensor,
        gain: torch.Tensor | None,
        numbers: list[float],
        predicted: list[float],
        iterations: int,
    ) -> PoseEstimate:
        """What an op of tracking found.

        Args:
            found: the pose float32 [7].
            gain: of the frame, the last two numbers; None where nothing says it.
            numbers: pose, H and the statistics of each iteration, read: 43 + 7 iterations.
            predicted: pose.
            iterations: that were made.
        """
        pose = numbers[:7]
        mean_square, inlier_share, _, _, mean_robust_weight, _, _ = numbers[-7:]
        error_cm, error_deg = prediction_error(predicted, pose)
        fit = Fit(
            residual_cm=100 * math.sqrt(max(mean_square, 0.0)),
            inlier_share=inlier_share,
            mean_robust_weight=mean_robust_weight,
            prediction_error_cm=error_cm,
            prediction_error_deg=error_deg,
        )
        pixels = self.config.tracking.pixels
        variance = pose_variance(mean_square) * pixels
        equations = SurfaceEquations(numbers[7 : ops.trusted.FOUND_NUMBERS], pixels, variance)
        return PoseEstimate(found, iterations, fit, equations, tuple(pose), gain)
