"""The pose of one frame: tracked, as its rows were read at the moments that its own motion says, and decided on."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import torch

from spslam import ops
from spslam.slam.fit import prediction_error
from spslam.slam.frame_history import FrameHistory
from spslam.slam.image_features import FrameFeatures
from spslam.slam.pixels import FramePixels
from spslam.slam.recovery.recovery import Recovery
from spslam.slam.recovery.tracked_frame import TrackedFrame
from spslam.slam.rolling_shutter import ShutterRectifier
from spslam.slam.tracker import Tracker, TrackingProblem


class Localizer:
    """Finds the pose of one frame at a time.

    A frame of a rolling shutter is rectified by predicted motion before it is tracked. Where the camera turned
    otherwise, that has bent the frame: it is rectified anew by the motion found, and tracked again.

    Args:
        tracker: optimizes poses.
        recovery: decides whether a pose is trusted, and looks for a better one.
        rectifier: of the camera.
    """

    def __init__(self, tracker: Tracker, recovery: Recovery, rectifier: ShutterRectifier):
        self._tracker, self._recovery, self._rectifier = tracker, recovery, rectifier

    def localize(
        self,
        problem: TrackingProblem,
        pixels: FramePixels,
        features: FrameFeatures,
        history: FrameHistory,
        to_be_mapped: bool,
        meanwhile: Callable[[], None] | None = None,
    ) -> TrackedFrame:
        """The pose of a frame; changes nothing.

        Args:
            problem: the frame.
            pixels: of the frame, as the problem has it.
            features: of the frame as it was read.
            history: the frames before.
            to_be_mapped: whether the frame is to be mapped if its pose is trusted; it is then checked for occlusion.
            meanwhile: as of `Tracker.track`.
        """
        shutter, read = problem.constraints.shutter, features.pixels
        estimate = self._tracker.track(problem, meanwhile)
        if shutter is not None and self._rectifier.bends(shutter, estimate.measured.prediction_error_deg):
            problem, pixels = self._rectified(problem, read, shutter._replace(pose=estimate.pose))
            again = self._tracker.track_from(problem, estimate.pose)
            estimate = replace(again, iterations=estimate.iterations + again.iterations)
        tracked = self._recovery.resolve(problem, estimate, pixels, history, to_be_mapped, features)
        shutter = problem.constraints.shutter
        # The pose that the frame was rectified by is the one that was tracked, unless it was recovered from elsewhere.
        if shutter is None or tracked.lost or not tracked.recovered:
            return tracked
        if not self._rectifier.bends(shutter, _turn_deg(shutter.pose, tracked.pose)):
            return tracked
        problem, pixels = self._rectified(problem, read, shutter._replace(pose=tracked.pose))
        estimate = self._tracker.track_from(problem, tracked.pose)
        found = self._recovery.resolve(problem, estimate, pixels, history, to_be_mapped, features)
        return tracked if found.lost else found.after(tracked)

    def _rectified(
        self, problem: TrackingProblem, read: FramePixels, motion: ops.ShutterMotion
    ) -> tuple[TrackingProblem, FramePixels]:
        """The frame as a motion has it."""
        pixels = self._rectifier.frame(read, motion)
        constraints = replace(problem.constraints, shutter=motion)
        return replace(problem, records=pixels.records, constraints=constraints), pixels


def _turn_deg(pose: torch.Tensor, other: torch.Tensor) -> float:
    """Between two poses float32 [7], degrees; waits for the device."""
    return prediction_error(pose.tolist(), other.tolist())[1]
