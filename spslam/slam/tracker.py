"""Finds the pose of one frame against the frozen map (section III.D)."""

import math
from dataclasses import dataclass, replace

import torch

from spslam import ops
from spslam.camera import Camera
from spslam.config import Config
from spslam.scene import Scene
from spslam.slam.frame_history import FrameHistory
from spslam.slam.pixels import FramePixels
from spslam.slam.recovery.icp_alignment import IcpAlignment
from spslam.slam.recovery.pose_confidence import SCORE_KERNEL_M, Fit, min_eigenvalue, prediction_error
from spslam.slam.recovery.verifier import Verifier
from spslam.slam.reference_image import ReferenceCache
from spslam.slam.render_options import render_options
from spslam.slam.state import FrameTable

AGREEING = 4  # frames in a row whose likely poses agree are found
AGREE_CM, AGREE_DEG = 5.0, 4.0  # from one frame to the next
AGREEING_DOUBT = 0.1  # of each at most
AGREEING_INFORMATION = 0.004  # of each at least: a plane agrees with itself wherever it is laid
MAPPED_SUPPORT = 0.7  # a frame to be mapped that has less may have something before the lens
LITTLE_DEPTH = 0.25  # of the picture
SHORT_LOSS = 5  # frames: for as long the camera cannot be far from where it was
RESCUE_GAIN = 0.02  # of support: less is the chance of another draw, and no other pose


@dataclass(frozen=True)
class TrackingResult:
    """A frame's pose and how well it fits.

    Attributes:
        pose: float32 [7].
        iterations: how many were made.
        fit: of the pose found, also where it is not taken.
        lost: whether the pose is not to be trusted.
        recovered: whether the pose comes from a start that ICP found.
        relocalized: whether that start was another frame than the last.
        consistent_frames: how many lost frames up to this one had likely poses that agree; `pose` is the last of them.
    """

    pose: torch.Tensor
    iterations: int
    fit: Fit
    lost: bool
    recovered: bool = False
    relocalized: bool = False
    consistent_frames: int = 0


class Tracker:
    """Tracks frames one after another; holds no state of its own but scratch."""

    def __init__(self, config: Config, camera: Camera):
        self.config = config
        self.camera = camera
        self.intrinsics = ops.Intrinsics(camera.fx, camera.fy, camera.cx, camera.cy)
        self._graph = ops.LaunchGraph()
        self._verifier = Verifier(config, camera)
        weight_m, kernel = config.tracking.color_weight_m, config.tracking.color_kernel
        self._references = ReferenceCache(camera, weight_m, kernel) if weight_m > 0 else None
        self._reference: ops.ReferenceImage | None = None
        self._views: ops.DepthKeyframes | None = None
        self._keyframes_from_the_start = False

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
        history: FrameHistory | None = None,
        to_be_mapped: bool = False,
    ) -> TrackingResult:
        """Optimizes the pose from `start`; where that is doubtful, tries again from where ICP leads.

        Args:
            scene: the map, not changed.
            pixels: of the frame.
            start: float32 [7] where the motion model puts the camera.
            frame: number of the frame, keys the random draws.
            history: the frames before; without it there is no second try.
            to_be_mapped: whether the frame is to be mapped if its pose is good.

        Returns:
            The best supported pose. Where the frame is lost, a likely one, or else `start`.
        """
        if self.has_too_little_depth(pixels):
            return TrackingResult(start.clone(), 0, Fit(), lost=True)
        self._reference = self._reference_image(history)
        self._views = history.depth_keyframes() if history else None
        self._keyframes_from_the_start = pixels.valid_depth_share < LITTLE_DEPTH
        adam = self.config.tracking.optimizer == "adam"
        find = self._track_adam if adam else self._track_gauss_newton
        result = find(scene, pixels.records, start, frame, self._iterations(frame))
        if history is not None and (history.is_lost or self._is_doubtful(result)):
            result = self._look_again(scene, pixels, start, frame, history, result)
        elif history is not None and to_be_mapped and result.fit.mean_robust_weight < MAPPED_SUPPORT:
            result = self._verified(scene, IcpAlignment(pixels, self.camera), history, result)
        if result.lost and not result.consistent_frames:
            # A start from lost frames was no more than likely.
            known = history.last() if history is not None and history.consistent_frames else None
            result = replace(result, pose=(start if known is None else known.pose).clone())
        return result

    def _reference_image(self, history: FrameHistory | None) -> ops.ReferenceImage | None:
        """What the last mapped frame looked like, where colors are to be compared."""
        mapped = history.mapped(self.config.mapping.every) if self._references and history else None
        if mapped is None or self._references is None:
            return None
        row, frame = mapped
        return self._references.of(row, frame.records, frame.pose)

    def has_too_little_depth(self, pixels: FramePixels) -> bool:
        """Whether too little of the image has depth to tell a pose from."""
        return len(pixels.records) == 0 or pixels.valid_depth_share < self.config.tracking.min_valid_depth_share

    def _iterations(self, frame: int) -> int:
        tracking = self.config.tracking
        return tracking.first_iterations if frame <= tracking.first_frames else tracking.iterations

    def _track_gauss_newton(
        self, scene: Scene, records: torch.Tensor, start: torch.Tensor, frame: int, iterations: int
    ) -> TrackingResult:
        return self._fitted(scene, records, start, start, frame, iterations, self.config.tracking.kernel_start_m)

    def _track_adam(
        self, scene: Scene, records: torch.Tensor, start: torch.Tensor, frame: int, iterations: int
    ) -> TrackingResult:
        tracking = self.config.tracking
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
        fitted = self._fitted(scene, records, start, best, frame, 1, tracking.kernel_end_m)
        return replace(fitted, pose=best, iterations=iterations)

    def _fitted(
        self,
        scene: Scene,
        records: torch.Tensor,
        expected: torch.Tensor,
        start: torch.Tensor,
        frame: int,
        iterations: int,
        kernel_start_m: float,
    ) -> TrackingResult:
        """Gauss-Newton from `start`, and how its pose fits; the jump is the way from the expected pose."""
        tracking = self.config.tracking
        pose, stats, hessian = ops.track_gauss_newton(
            scene.view(),
            records,
            start,
            self.intrinsics,
            ops.GaussNewtonOptions(
                num_pixels=tracking.pixels,
                iterations=iterations,
                truncation=scene.settings.truncation_m,
                kernel_start=kernel_start_m,
                kernel_end=tracking.kernel_end_m,
                score_kernel=SCORE_KERNEL_M,
                damping=tracking.damping,
                seed=self.config.seed,
                stream=ops.Stream.TRACKING_PIXELS,
                frame=frame,
                noise_crossover_depth=tracking.noise_crossover_depth_m,
            ),
            reference=self._reference,
            depth_keyframes=self._keyframes_of(iterations),
        )
        # The frame's one wait for the device.
        numbers = torch.cat([expected, pose, stats[-1], hessian.view(-1)]).tolist()
        cost, inlier_share, _, _, mean_robust_weight = numbers[14:19]
        fit = Fit(
            100 * math.sqrt(max(cost, 0.0)),
            inlier_share,
            mean_robust_weight,
            min_eigenvalue(numbers[19:], tracking.pixels),
            *prediction_error(numbers[:7], numbers[7:14]),
        )
        return TrackingResult(pose, iterations, fit, self._is_lost(fit))

    def _keyframes_of(self, iterations: int) -> ops.DepthKeyframes | None:
        """The views, which join in the second half: the map alone brings a pose from farther away.

        A strip of depth would slide along the map before that, so there they hold the pose from the start.
        """
        if self._views is None or self._keyframes_from_the_start:
            return self._views
        return self._views._replace(first_iteration=iterations // 2)

    def _is_lost(self, fit: Fit) -> bool:
        """Whether the pose is to be given up; one of NaN has no inliers."""
        tracking = self.config.tracking
        return not (fit.inlier_share >= tracking.min_inlier_share and fit.error_probability <= tracking.lost_threshold)

    def _is_doubtful(self, result: TrackingResult) -> bool:
        """Whether so little speaks for the pose that it may be a wrong one."""
        tracking = self.config.tracking
        return (
            result.lost
            or result.fit.error_probability > tracking.verify_threshold
            or result.fit.mean_robust_weight < tracking.recovery_min_robust_weight
        )

    def _look_again(
        self,
        scene: Scene,
        pixels: FramePixels,
        start: torch.Tensor,
        frame: int,
        history: FrameHistory,
        first: TrackingResult,
    ) -> TrackingResult:
        """The best supported of the first result and those that ICP leads to, held against what other frames saw.

        It begins at the last trusted frame, and where that is no good at the stored frames that look most alike.
        """
        tracking, alignment, best = self.config.tracking, IcpAlignment(pixels, self.camera), first
        last = history.last() if tracking.rescue and (tracking.optimizer == "gauss_newton" or first.lost) else None
        starts = [] if last is None else [alignment.pose(last, guess) for guess in (start, last.pose)]
        best = self._best(scene, pixels, starts, start, frame, best)
        # After lost frames whose poses agree, the way to where the camera was is not that from the start.
        if history.consecutive_lost_frames <= SHORT_LOSS and not history.consistent_frames:
            best = self._verified(scene, alignment, history, best, pixels.records)
            if not best.lost:
                return best
        alike = history.similar(pixels, tracking.relocalization_candidates)
        starts = [alignment.pose(other.frame, other.start) for other in alike]
        found = self._best(scene, pixels, starts, start, frame, best)
        found = self._found_again(self._verified(scene, alignment, history, found, pixels.records), history)
        return replace(found, relocalized=found.pose is not best.pose and not found.lost)

    def _best(
        self,
        scene: Scene,
        pixels: FramePixels,
        starts: list[torch.Tensor],
        expected: torch.Tensor,
        frame: int,
        best: TrackingResult,
    ) -> TrackingResult:
        """The best supported of a result and those from other starts; its iterations are those of all."""
        iterations = best.iterations
        kernel_m, tracking = self.config.tracking.kernel_start_m, self.config.tracking
        for guess in starts:
            again = self._fitted(scene, pixels.records, expected, guess, frame, tracking.iterations, kernel_m)
            iterations += again.iterations
            if again.fit.mean_robust_weight > best.fit.mean_robust_weight + RESCUE_GAIN:
                best = replace(again, recovered=True)
        return replace(best, iterations=iterations)

    def _verified(
        self,
        scene: Scene,
        alignment: IcpAlignment,
        history: FrameHistory,
        result: TrackingResult,
        records: torch.Tensor | None = None,
    ) -> TrackingResult:
        """The result, judged anew with what else is known; by its colors too where its pixel records are given."""
        fit = self._verifier.verified(result.fit, result.pose, scene, alignment, history, records)
        return replace(result, fit=fit, lost=self._is_lost(fit))

    def _found_again(self, result: TrackingResult, history: FrameHistory) -> TrackingResult:
        """The result, judged as that of a camera that may be anywhere: of all places some are always alike.

        The motion model has no say in the doubt, and there must be next to none; or little, in some frames one after
        another whose poses agree.
        """
        tracking = self.config.tracking
        agrees = result.fit.prediction_error_cm < AGREE_CM and result.fit.prediction_error_deg < AGREE_DEG
        fit = replace(result.fit, prediction_error_cm=math.nan, prediction_error_deg=math.nan)
        if fit.error_probability <= tracking.relocalization_threshold and not self._is_lost(fit):
            return replace(result, fit=fit, lost=False, consistent_frames=0)
        likely = fit.error_probability <= AGREEING_DOUBT and fit.min_eigenvalue >= AGREEING_INFORMATION
        consistent_frames = int(likely and not self._is_lost(fit)) * (1 + history.consistent_frames * int(agrees))
        if consistent_frames >= AGREEING:
            return replace(result, fit=fit, lost=False, consistent_frames=0)
        return replace(result, fit=fit, lost=True, consistent_frames=consistent_frames)
