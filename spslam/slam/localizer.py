"""The pose of one frame: tracked, as its rows were read at the moments that its own motion says, and decided on."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import torch

from spslam import ops
from spslam.slam.constraints import Constraints
from spslam.slam.fit import prediction_error
from spslam.slam.frame_history import FrameHistory
from spslam.slam.image_features import FrameFeatures
from spslam.slam.pixels import FramePixels
from spslam.slam.recovery.recovery import Recovery
from spslam.slam.recovery.tracked_frame import TrackedFrame
from spslam.slam.rolling_shutter import ShutterRectifier
from spslam.slam.state import SlamState
from spslam.slam.tracker import FollowedFrame, FrameOutcome, PoseEstimate, Tracker, TrackingProblem


class LocalizedFrame(NamedTuple):
    """A frame with its pose.

    Attributes:
        tracked: what was decided on.
        motion: the motion to that pose, by which the frame is rectified; None where that does not matter.
        pixels: rectified by it, else as they were read.
    """

    tracked: TrackedFrame
    motion: ops.ShutterMotion | None
    pixels: FramePixels


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
        estimate = self._tracker.track(problem, meanwhile)
        return self._unbent(problem, pixels, estimate, features, history, to_be_mapped)

    def next_frame(
        self,
        state: SlamState,
        features: FrameFeatures,
        history: FrameHistory,
        constraints: Constraints,
        seconds: float | None,
        to_be_mapped: bool,
        meanwhile: Callable[[], None] | None = None,
        start: torch.Tensor | None = None,
    ) -> LocalizedFrame:
        """The next frame of a camera, predicted, tracked and rectified; changes nothing.

        Args:
            state: before the frame.
            features: of the frame as it was read.
            history: the frames before.
            constraints: of the frame, without its motion.
            seconds: from the last frame to this one; None where the motion in between does not matter.
            to_be_mapped, meanwhile: as of `localize`.
            start: float32 [7], where the camera is taken to be; None predicts it by its motion.
        """
        read, number, pixels = features.pixels, len(state.frames), None
        if seconds is None:
            predicted = self._tracker.predict(state.frames, history.steps) if start is None else start
            problem = TrackingProblem(state.scene, read.records, predicted, number, constraints)
            return LocalizedFrame(self.localize(problem, read, features, history, to_be_mapped, meanwhile), None, read)
        if start is None and self._tracker.can_follow(state.frames):
            moving, bent_turn = self._rectifier.moving(read, state, seconds, history.steps), self._rectifier.bent_turn
            found = self._tracker.follow(state.scene, moving, bent_turn, number, constraints, meanwhile)
            tracked, motion = self._recovery.settled(found.estimate, history, to_be_mapped), found.motion
            if tracked is None or found.outcome == FrameOutcome.FAR:
                tracked = self._decided(found, features, history, to_be_mapped)
            else:
                records, depth, intensity = found.rectified
                pixels = read.having(records=records, depth_image=depth, intensity_image=intensity)
        else:
            motion, predicted_pixels = self._rectifier.predict(read, state, seconds, history.steps)
            if start is not None:
                motion = motion._replace(pose=start)
                predicted_pixels = self._rectifier.frame(read, motion)
            constraints = replace(constraints, shutter=motion)
            problem = TrackingProblem(state.scene, predicted_pixels.records, motion.pose, number, constraints)
            tracked = self.localize(problem, predicted_pixels, features, history, to_be_mapped, meanwhile)
        if tracked.lost:
            return LocalizedFrame(tracked, None, read)
        motion = motion._replace(pose=tracked.pose)
        return LocalizedFrame(tracked, motion, self._rectifier.frame(read, motion) if pixels is None else pixels)

    def _decided(
        self, found: FollowedFrame, features: FrameFeatures, history: FrameHistory, to_be_mapped: bool
    ) -> TrackedFrame:
        """The pose of a frame that was followed, where its fit alone does not decide."""
        problem, read = found.problem, features.pixels
        if found.outcome == FrameOutcome.BENT:
            problem, pixels = self._rectified(problem, read, found.motion._replace(pose=found.first_pose))
            return self._resolved(problem, pixels, found.estimate, features, history, to_be_mapped)
        pixels = read.having(records=problem.records)
        if found.outcome == FrameOutcome.SETTLED:
            return self._resolved(problem, pixels, found.estimate, features, history, to_be_mapped)
        estimate = self._tracker.track_on(problem, found.estimate)
        return self._unbent(problem, pixels, estimate, features, history, to_be_mapped)

    def _unbent(
        self,
        problem: TrackingProblem,
        pixels: FramePixels,
        estimate: PoseEstimate,
        features: FrameFeatures,
        history: FrameHistory,
        to_be_mapped: bool,
    ) -> TrackedFrame:
        """The pose decided on, after the frame was tracked again where predicted motion has bent it."""
        shutter, read = problem.constraints.shutter, features.pixels
        if shutter is not None and self._rectifier.bends(shutter, estimate.measured.prediction_error_deg):
            problem, pixels = self._rectified(problem, read, shutter._replace(pose=estimate.pose))
            again = self._tracker.track_again(problem, estimate.pose)
            estimate = replace(again, iterations=estimate.iterations + again.iterations)
        return self._resolved(problem, pixels, estimate, features, history, to_be_mapped)

    def _resolved(
        self,
        problem: TrackingProblem,
        pixels: FramePixels,
        estimate: PoseEstimate,
        features: FrameFeatures,
        history: FrameHistory,
        to_be_mapped: bool,
    ) -> TrackedFrame:
        """The pose decided on, tracked again where the frame was recovered from elsewhere than it was rectified by."""
        tracked = self._recovery.resolve(problem, estimate, pixels, history, to_be_mapped, features)
        shutter = problem.constraints.shutter
        # The pose that the frame was rectified by is the one that was tracked, unless it was recovered from elsewhere.
        if shutter is None or tracked.lost or not tracked.recovered:
            return tracked
        if not self._rectifier.bends(shutter, _turn_deg(shutter.pose, tracked.pose)):
            return tracked
        problem, pixels = self._rectified(problem, features.pixels, shutter._replace(pose=tracked.pose))
        estimate = self._tracker.track_again(problem, tracked.pose)
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
