"""Maps beside the one that frames are mapped in (multi-map SLAM): one that was opened, and one for a lost camera.

A system that goes on in the map of a finished run has to find the camera in it before anything else. One whose camera
is lost begins a new map for what it sees (`spslam.slam.segments`), which joins the first one later.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import torch

from spslam.config import Config
from spslam.slam.constraints import Constraints
from spslam.slam.graph.global_mapping import GlobalMapping
from spslam.slam.pixels import FramePixels
from spslam.slam.poses import pose_tensor
from spslam.slam.prepared_frame import PreparedFrame
from spslam.slam.recovery.recovery import Recovery
from spslam.slam.recovery.tracked_frame import TrackedFrame
from spslam.slam.segments import Segments, SegmentSystem, segment_config
from spslam.slam.state import SlamState
from spslam.slam.tracker import Tracker, TrackingProblem


class MultiMap:
    """The other maps of a system.

    Args:
        config: options of the system.
        state: of the system.
        global_mapping: of the system; None without a keyframe graph, and then there is no other map.
        tracker: of the system.
        recovery: of the system.
        make: a system of the same camera without frames, by its options and the pose of its first frame.
    """

    def __init__(
        self,
        config: Config,
        state: SlamState,
        global_mapping: GlobalMapping | None,
        tracker: Tracker,
        recovery: Recovery,
        make: Callable[..., SegmentSystem],
    ):
        self._config, self._state, self._global_mapping = config, state, global_mapping
        self._tracker, self._recovery = tracker, recovery
        self._segments: Segments | None = None
        after_s = config.graph.new_map_after_s
        if global_mapping is not None and after_s is not None:
            # Nothing here refers back to the system, so that its memory goes with it.
            make_segment = functools.partial(_segment_system, make, segment_config(config))
            self._segments = Segments(after_s, state, global_mapping, make_segment)

    def close(self) -> None:
        """Ends the threads of the segment's system."""
        if self._segments is not None:
            self._segments.close()

    def find_camera(self, pixels: FramePixels, number: int, noise: torch.Tensor, has_depth: bool) -> TrackedFrame:
        """The pose of a frame in the map that was opened, in which none was found yet.

        Args:
            pixels: of the frame.
            number: of the frame.
            noise: float32 [4] of the sensor, as measured up to now.
            has_depth: whether enough of the image has depth to determine a pose.

        Returns:
            The frame, relocalized, or lost at the pose of the one before.
        """
        frames = self._state.frames
        nowhere = TrackedFrame.untracked(frames.poses[-1].clone(), lost=True)
        if self._global_mapping is None or not has_depth:
            return nowhere
        found = self._global_mapping.find(number, pixels)
        if found is None:
            return nowhere
        start = pose_tensor(found, self._state.scene.device)
        problem = TrackingProblem(self._state.scene, pixels.records, start, number, Constraints(noise))
        tracked = self._recovery.judge(self._tracker.track_from(problem, start))
        is_sure = tracked.error_probability <= self._config.tracking.relocalization_threshold and not tracked.lost
        return replace(tracked, relocalized=True) if is_sure else replace(nowhere, fit=tracked.fit)

    def after_frame(self, frame: PreparedFrame, pixels: FramePixels, has_depth: bool) -> np.ndarray | None:
        """Begins, follows and ends segments, while the camera is lost and until it is known where they lie.

        Args:
            frame: the newest of the state.
            pixels: its, on the device.
            has_depth: whether enough of the image has depth for a segment to begin with it.

        Returns:
            float64 [4, 4] T_world_segment, with which `join` is to be called; None where there is nothing to join.
        """
        return None if self._segments is None else self._segments.after_frame(frame, pixels, has_depth)

    def take_over(self, adopt: Callable[[SlamState], None]) -> None:
        """Between two frames: puts a segment in the place of the system's map, if that had hardly begun.

        Args:
            adopt: called with the system's state if it did; it is the same object, with other content.
        """
        if self._segments is not None and self._segments.replace_young_map():
            adopt(self._state)

    def join(self, place: np.ndarray) -> None:
        """Joins the segment with the map; no optimization of the map may be left to make.

        Args:
            place: float64 [4, 4] T_world_segment.
        """
        if self._segments is None:
            raise ValueError("MultiMap.join: there must be a segment")
        self._segments.join(place)

    def end(self) -> None:
        """After the last frame: what is not joined by now is kept apart."""
        if self._segments is not None:
            self._segments.end()


def _segment_system(
    make: Callable[..., SegmentSystem], config: Config, state: SlamState | None, first_pose: np.ndarray | None
) -> SegmentSystem:
    """A system for what a lost camera sees, that of a state if one is given."""
    system = make(config, first_pose=first_pose)
    if state is not None:
        system.adopt(state)
    return system
