"""Decides whether a tracked pose is trusted, and looks for a better one where it is not."""

import math
from dataclasses import dataclass, replace

import torch

from spslam.camera import Camera
from spslam.config import Config
from spslam.slam.fit import Fit
from spslam.slam.frame_history import FrameHistory
from spslam.slam.pixels import FramePixels
from spslam.slam.recovery.icp_alignment import IcpAlignment
from spslam.slam.recovery.place_recognition import retrieve
from spslam.slam.recovery.pose_confidence import PoseConfidenceModel
from spslam.slam.recovery.verifier import Verifier
from spslam.slam.tracker import PoseEstimate, Tracker, TrackingProblem

CONSISTENT_FRAMES = 4  # lost frames in a row whose likely poses are consistent are found
CONSISTENT_CM, CONSISTENT_DEG = 5.0, 4.0  # most prediction error from one of them to the next
LIKELY_ERROR_PROBABILITY = 0.1  # of each of them at most
LIKELY_MIN_EIGENVALUE = 0.004  # of each of them at least: poses that slide along a plane are consistent too
OCCLUSION_CHECK_WEIGHT = 0.7  # a frame to be mapped with a smaller mean robust weight may be occluded
SHORT_LOSS = 5  # lost frames in a row after which the camera is still near its last trusted pose
MIN_GAIN = 0.02  # of mean robust weight; smaller differences come from the random choice of pixels


@dataclass(frozen=True)
class TrackedFrame:
    """A frame's pose and whether it is trusted.

    Attributes:
        pose: float32 [7]; where the frame is lost, a likely pose, the last trusted or the predicted one.
        iterations: of tracking, summed over all initial poses.
        fit: of the pose found, also where it is not trusted.
        error_probability: that the pose is wrong; NaN where it was not tracked.
        lost: whether the pose is not trusted.
        occluded: whether something that is not part of the scene is in front of the camera.
        recovered: whether the pose was tracked from an initial pose that ICP found.
        relocalized: whether ICP found it against a stored frame that looks alike.
        consistent_frames: how many lost frames up to this one had likely poses that are consistent; `pose` is the
            last of them.
    """

    pose: torch.Tensor
    iterations: int
    fit: Fit
    error_probability: float
    lost: bool
    occluded: bool = False
    recovered: bool = False
    relocalized: bool = False
    consistent_frames: int = 0

    @classmethod
    def untracked(cls, pose: torch.Tensor, lost: bool) -> "TrackedFrame":
        """A frame at a given pose, of which nothing was measured."""
        return cls(pose, 0, Fit(), math.nan, lost)


class Recovery:
    """Decides whether a pose estimate is trusted. Only a doubtful one is verified and tracked again.

    Args:
        config: options of the run.
        camera: of all frames.
        tracker: optimizes the pose from other initial poses.
        confidence: computes the probability that a pose is wrong.
    """

    def __init__(self, config: Config, camera: Camera, tracker: Tracker, confidence: PoseConfidenceModel):
        self._config, self._camera, self._tracker, self._confidence = config, camera, tracker, confidence
        self._verifier = Verifier(config, camera, confidence)

    def judge(self, estimate: PoseEstimate) -> TrackedFrame:
        """The estimate, trusted or not by its fit alone."""
        return self._judged(TrackedFrame(estimate.pose, estimate.iterations, estimate.fit, math.nan, lost=True))

    def resolve(
        self,
        problem: TrackingProblem,
        estimate: PoseEstimate,
        pixels: FramePixels,
        history: FrameHistory,
        to_be_mapped: bool,
    ) -> TrackedFrame:
        """The frame's best pose: the estimate or, if it is doubtful, the best one from other initial poses.

        Args:
            problem: the frame.
            estimate: the tracker's result.
            pixels: of the frame.
            history: the frames before.
            to_be_mapped: whether the frame is to be mapped if its pose is trusted.
        """
        tracked = self.judge(estimate)
        if history.is_lost or self._is_doubtful(tracked):
            tracked = self._recover(problem, tracked, pixels, history)
        elif to_be_mapped and tracked.fit.mean_robust_weight < OCCLUSION_CHECK_WEIGHT:
            tracked = self._verify(problem, tracked, IcpAlignment(pixels, self._camera), history, with_colors=False)
        if not tracked.lost or tracked.consistent_frames:
            return tracked
        # A pose predicted from lost frames is not trusted: continue from the last trusted pose.
        known = history.last() if history.consistent_frames else None
        return replace(tracked, pose=(problem.predicted if known is None else known.pose).clone())

    def _judged(self, tracked: TrackedFrame) -> TrackedFrame:
        """The frame with what its fit says of its pose; one of NaN has no inliers."""
        tracking, probability = self._config.tracking, self._confidence.error_probability(tracked.fit)
        return replace(
            tracked,
            error_probability=probability,
            lost=not (tracked.fit.inlier_share >= tracking.min_inlier_share and probability <= tracking.lost_threshold),
            occluded=self._confidence.is_occluded(tracked.fit),
        )

    def _is_doubtful(self, tracked: TrackedFrame) -> bool:
        tracking = self._config.tracking
        return (
            tracked.lost
            or tracked.error_probability > tracking.verify_threshold
            or tracked.fit.mean_robust_weight < tracking.recovery_min_robust_weight
        )

    def _verify(
        self,
        problem: TrackingProblem,
        tracked: TrackedFrame,
        alignment: IcpAlignment,
        history: FrameHistory,
        with_colors: bool = True,
    ) -> TrackedFrame:
        records = problem.records if with_colors else None
        fit = self._verifier.verified(tracked.fit, tracked.pose, problem.scene, alignment, history, records)
        return self._judged(replace(tracked, fit=fit))

    def _recover(
        self, problem: TrackingProblem, first: TrackedFrame, pixels: FramePixels, history: FrameHistory
    ) -> TrackedFrame:
        """The best result from the prediction and the last trusted frame; if that is lost, also from similar frames."""
        alignment = IcpAlignment(pixels, self._camera)
        best = self._best(problem, first, self._starts_at_last(problem, first, alignment, history))
        # After lost frames with consistent poses, the prediction does not come from the last trusted pose.
        if history.consecutive_lost_frames <= SHORT_LOSS and not history.consistent_frames:
            best = self._verify(problem, best, alignment, history)
            if not best.lost:
                return best
        return self._relocalize(problem, best, alignment, pixels, history)

    def _starts_at_last(
        self, problem: TrackingProblem, first: TrackedFrame, alignment: IcpAlignment, history: FrameHistory
    ) -> list[torch.Tensor]:
        """Poses by ICP against the last trusted frame, from the predicted pose and from that frame's own."""
        tracking = self._config.tracking
        wanted = tracking.recovery and (tracking.optimizer == "gauss_newton" or first.lost)
        last = history.last() if wanted else None
        return [] if last is None else [alignment.pose(last, start) for start in (problem.predicted, last.pose)]

    def _best(self, problem: TrackingProblem, best: TrackedFrame, starts: list[torch.Tensor]) -> TrackedFrame:
        """The result of the largest mean robust weight among a given one and those from other starts."""
        iterations = best.iterations
        for start in starts:
            other = self.judge(self._tracker.track_from(problem, start))
            iterations += other.iterations
            if other.fit.mean_robust_weight > best.fit.mean_robust_weight + MIN_GAIN:
                best = replace(other, recovered=True)
        return replace(best, iterations=iterations)

    def _relocalize(
        self,
        problem: TrackingProblem,
        best: TrackedFrame,
        alignment: IcpAlignment,
        pixels: FramePixels,
        history: FrameHistory,
    ) -> TrackedFrame:
        """The best of a given result and those from stored frames that look alike, if it is certain enough."""
        candidates = retrieve(history, pixels, self._config.tracking.relocalization_candidates, self._camera)
        starts = [alignment.pose(candidate.earlier, candidate.start) for candidate in candidates]
        found = self._verify(problem, self._best(problem, best, starts), alignment, history)
        found = self._accept_anywhere(found, history.consistent_frames)
        return replace(found, relocalized=found.pose is not best.pose and not found.lost)

    def _accept_anywhere(self, tracked: TrackedFrame, consistent_before: int) -> TrackedFrame:
        """The result, accepted by stricter thresholds, as the camera may be anywhere and some places look alike.

        The error probability is computed without the prediction error. It must be at most
        `tracking.relocalization_threshold`, or at most `LIKELY_ERROR_PROBABILITY` in `CONSISTENT_FRAMES` consecutive
        frames with consistent poses.
        """
        is_consistent = (
            tracked.fit.prediction_error_cm < CONSISTENT_CM and tracked.fit.prediction_error_deg < CONSISTENT_DEG
        )
        fit = replace(tracked.fit, prediction_error_cm=math.nan, prediction_error_deg=math.nan)
        tracked = self._judged(replace(tracked, fit=fit))
        if tracked.error_probability <= self._config.tracking.relocalization_threshold and not tracked.lost:
            return replace(tracked, consistent_frames=0)
        is_likely = (
            tracked.error_probability <= LIKELY_ERROR_PROBABILITY and fit.min_eigenvalue >= LIKELY_MIN_EIGENVALUE
        )
        frames = int(is_likely and not tracked.lost) * (1 + consistent_before * int(is_consistent))
        if frames >= CONSISTENT_FRAMES:
            return replace(tracked, lost=False, consistent_frames=0)
        return replace(tracked, lost=True, consistent_frames=frames)
