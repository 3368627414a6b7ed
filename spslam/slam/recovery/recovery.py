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
LIKELY_MIN_EIGENVALUE = 0.004  # of each of them at least: a plane is consistent with itself wherever it is laid
OCCLUSION_CHECK_WEIGHT = 0.7  # a frame to be mapped with a smaller mean robust weight may be obstructed
SHORT_LOSS = 5  # frames; for as long the camera cannot be far from where it was
MIN_GAIN = 0.02  # of mean robust weight: less is the chance of another draw, and no other pose


@dataclass(frozen=True)
class TrackedFrame:
    """A frame's pose and whether it is trusted.

    Attributes:
        pose: float32 [7]; where the frame is lost, a likely pose, the last known or the predicted one.
        iterations: of tracking, all starts together.
        fit: of the pose found, also where it is not trusted.
        error_probability: that the pose is wrong; NaN where it was not tracked.
        lost: whether the pose is not trusted.
        obstructed: whether something that is no part of the scene stands before the camera.
        recovered: whether the pose comes from a start that ICP found.
        relocalized: whether that start was another frame than the last.
        consistent_frames: how many lost frames up to this one had likely poses that are consistent; `pose` is the
            last of them.
    """

    pose: torch.Tensor
    iterations: int
    fit: Fit
    error_probability: float
    lost: bool
    obstructed: bool = False
    recovered: bool = False
    relocalized: bool = False
    consistent_frames: int = 0

    @classmethod
    def untracked(cls, pose: torch.Tensor, lost: bool) -> "TrackedFrame":
        """A frame at a given pose, of which nothing was measured."""
        return cls(pose, 0, Fit(), math.nan, lost)


class Recovery:
    """From a pose estimate to a decision. A frame without doubt costs nothing but the decision.

    Args:
        config: settings.
        camera: of all frames.
        tracker: optimizes the pose from other starts.
        confidence: tells how probable an error is.
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
        """The frame's best pose: the estimate, or where that is doubtful the best of what other starts lead to.

        Args:
            problem: the frame.
            estimate: what tracking made of it.
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
        # The prediction from lost frames is no more than likely.
        known = history.last() if history.consistent_frames else None
        return replace(tracked, pose=(problem.predicted if known is None else known.pose).clone())

    def _judged(self, tracked: TrackedFrame) -> TrackedFrame:
        """The frame with what its fit says of its pose; one of NaN has no inliers."""
        tracking, probability = self._config.tracking, self._confidence.error_probability(tracked.fit)
        return replace(
            tracked,
            error_probability=probability,
            lost=not (tracked.fit.inlier_share >= tracking.min_inlier_share and probability <= tracking.lost_threshold),
            obstructed=self._confidence.is_obstructed(tracked.fit),
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
        """The best of the first result and of those from the last trusted frame; of similar frames if that is lost."""
        alignment = IcpAlignment(pixels, self._camera)
        best = self._best(problem, first, self._starts_at_last(problem, first, alignment, history))
        # After lost frames whose poses are consistent, the prediction is not where the camera was last known.
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
        return [] if last is None else [alignment.pose(last, guess) for guess in (problem.predicted, last.pose)]

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
        starts = [alignment.pose(candidate.keyframe, candidate.start) for candidate in candidates]
        found = self._verify(problem, self._best(problem, best, starts), alignment, history)
        found = self._accept_anywhere(found, history.consistent_frames)
        return replace(found, relocalized=found.pose is not best.pose and not found.lost)

    def _accept_anywhere(self, tracked: TrackedFrame, consistent_before: int) -> TrackedFrame:
        """The result, judged as that of a camera that may be anywhere: some places always look alike.

        The motion model has no say in the probability of an error, and that must be next to nothing; or small, in some
        frames in a row whose poses are consistent with one another.
        """
        prediction = tracked.fit
        is_consistent = (
            prediction.prediction_error_cm < CONSISTENT_CM and prediction.prediction_error_deg < CONSISTENT_DEG
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
