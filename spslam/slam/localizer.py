"""The pose of one frame: tracked, as its rows were read at the moments that its own motion says, and decided on."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import torch

from spslam.slam.fit import prediction_error
from spslam.slam.frame_history import FrameHistory
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
        read: FramePixels,
        history: FrameHistory,
        to_be_mapped: bool,
        meanwhile: Callable[[], None] | None = None,
    ) -> TrackedFrame:
        """The pose of a frame; changes nothing.

        Args:
            problem: the frame.
            pixels: of the frame, as the problem has it.
            read: the frame as it was read.
            history: the frames before.
            to_be_mapped: whether the frame is to be mapped if its pose is trusted; it is then checked for occlusion.
            meanwhile: as of `Tracker.track`.
        """
        estimate = self._tracker.track(problem, meanwhile)
        if self._is_bent(problem, estimate.fit.prediction_error_deg):
            problem, pixels = self._rectified(problem, read, estimate.pose)
            again = self._tracker.track_from(problem, estimate.pose)
            estimate = replace(again, iterations=estimate.iterations + again.iterations)
        tracked = self._recovery.resolve(problem, estimate, pixels, history, to_be_mapped)
        if tracked.lost or not self._is_bent(problem, _turn_deg(problem, tracked)):
            return tracked
        problem, pixels = self._rectified(problem, read, tracked.pose)
        estimate = self._tracker.track_from(problem, tracked.pose)
        found = self._recovery.resolve(problem, estimate, pixels, history, to_be_mapped, tracked.features)
        return tracked if found.lost else found.after(tracked)

    def _is_bent(self, problem: TrackingProblem, turn_deg: float) -> bool:
        """Whether the frame was rectified by a motion from which the one found differs by a turn that shows."""
        shutter = problem.constraints.shutter
        return shutter is not None and self._rectifier.bends(shutter, turn_deg)

    def _rectified(
        self, problem: TrackingProblem, read: FramePixels, pose: torch.Tensor
    ) -> tuple[TrackingProblem, FramePixels]:
        """The frame as the motion to a pose float32 [7] has it."""
        assert problem.constraints.shutter is not None
        shutter = problem.constraints.shutter._replace(pose=pose)
        pixels = self._rectifier.frame(read, shutter)
        constraints = replace(problem.constraints, shutter=shutter)
        return replace(problem, records=pixels.records, constraints=constraints), pixels


def _turn_deg(problem: TrackingProblem, tracked: TrackedFrame) -> float:
    """Between the pose that a frame was rectified by and one found from other starts, degrees; waits for the device."""
    shutter = problem.constraints.shutter
    if shutter is None or not tracked.recovered:
        return 0.0
    return prediction_error(shutter.pose.tolist(), tracked.pose.tolist())[1]
