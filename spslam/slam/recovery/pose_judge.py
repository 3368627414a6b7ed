"""Decides by its fit whether a pose is trusted."""

from dataclasses import replace
from typing import Any

from spslam.config import Config
from spslam.slam.fit import Fit
from spslam.slam.frame_history import FrameHistory
from spslam.slam.recovery.pose_confidence import PoseConfidenceModel
from spslam.slam.recovery.sliding import is_consistent
from spslam.slam.recovery.tracked_frame import TrackedFrame
from spslam.slam.tracker import PoseEstimate


class PoseJudge:
    """Decides by a fit, and by nothing else, whether its pose is trusted.

    Args:
        config: options of the run.
        confidence: computes the probability that a pose is wrong.
    """

    def __init__(self, config: Config, confidence: PoseConfidenceModel):
        self._config, self._confidence = config, confidence

    def judge(self, estimate: PoseEstimate, history: FrameHistory | None = None) -> TrackedFrame:
        """A result of the tracker, trusted or not; `history` as of `judged`."""
        fit, numbers = estimate.fit, estimate.numbers
        return TrackedFrame(
            estimate.pose,
            estimate.iterations,
            fit,
            **self._judgement(fit, history),
            equations=estimate.equations,
            gain=estimate.gain,
            on_host=None if numbers is None else (estimate.pose, numbers),
        )

    def judged(self, tracked: TrackedFrame, history: FrameHistory | None = None) -> TrackedFrame:
        """The frame with what its fit says of its pose.

        Args:
            tracked: the frame.
            history: the frames before it, which say how long ago the last one was; None where nothing is followed.
        """
        return replace(tracked, **self._judgement(tracked.fit, history))

    def _judgement(self, fit: Fit, history: FrameHistory | None) -> dict[str, Any]:
        """What a fit says of its pose, as fields of `TrackedFrame`; one of NaN has no inliers."""
        tracking, probability = self._config.tracking, self._confidence.error_probability(fit)
        is_somewhere = fit.inlier_share >= tracking.min_inlier_share or self._is_followed(fit, history)
        is_trusted = is_somewhere and probability <= tracking.lost_threshold
        occluded = self._confidence.is_occluded(fit)
        return {"error_probability": probability, "lost": not is_trusted, "occluded": occluded}

    def _is_followed(self, fit: Fit, history: FrameHistory | None) -> bool:
        """A camera that turns to what was not seen yet leaves the map, while features of the last frames hold it; one
        that has jumped has to be found on the map."""
        return self._confidence.is_held(fit) and is_consistent(fit, history)
