"""A map of its own for a camera that is lost, so that nothing that it sees is thrown away.

While the camera is lost, a second system without a past tracks and maps the frames (a segment). When the camera is
known in the first map again, both know where it was in the same frames, which says where the segment lies: its frames
get poses in the first map, and its keyframes are mapped there.

A map that was lost when it had hardly begun is often of a hand, or of what was before the camera when it was taken up.
A segment that knows twice as many frames takes its place.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any, Protocol

import numpy as np
import torch

from spslam.config import Config
from spslam.geometry import compose, inverse, matrix_to_pose7, rotation_angle
from spslam.slam.frame_table import FrameTable
from spslam.slam.graph.edges import Link
from spslam.slam.graph.global_mapping import GlobalMapping
from spslam.slam.graph.keyframe import Keyframe
from spslam.slam.pixels import FramePixels
from spslam.slam.poses import pose_tensor
from spslam.slam.prepared_frame import PreparedFrame
from spslam.slam.state import Segment, SlamState, UnjoinedFrames

SETTLED_FRAMES = 3  # in a row that both maps know, and in which they move alike, before they are joined
AGREE_M, AGREE_RAD = 0.05, 0.04  # to which these say the same of where the segment lies
MAX_TRIES = 60  # frames that the first map knows; a segment that has not fitted by then never will
NEVER = 10**9  # frames
# A map of so short a time has hardly begun: a segment begins once the camera was lost for at most so long, and takes
# its place when it knows so many times as many frames.
YOUNG_S, YOUNG_AFTER_S, TIMES_AS_MANY = 5.0, 0.5, 2


class SegmentSystem(Protocol):
    """What tracks and maps a segment: a `FramePipeline`."""

    state: SlamState

    def submit(self, frame: PreparedFrame) -> Any:
        """Tracks and maps the next frame."""

    def adopt(self, state: SlamState) -> None:
        """Goes on from a state of the same options and camera."""

    def close(self) -> None:
        """Ends its threads."""


def segment_config(config: Config) -> Config:
    """Options of a segment's system: no segment in a segment, no solution of its graph, no long first optimization."""
    graph = config.graph.model_copy(update={"new_map_after_s": None, "every": NEVER})
    mapping = config.mapping.model_copy(update={"first_iterations": config.mapping.iterations})
    run = config.run.model_copy(update={"graph_solver": "thread"})
    return config.model_copy(update={"graph": graph, "mapping": mapping, "run": run})


class Segments:
    """Begins, follows, joins and ends segments; at most one at a time.

    Args:
        after_s: how long the camera is lost before one begins.
        state: of the system that may be lost.
        global_mapping: of the same system.
        make: a system without frames, or that of a given state; its first frame will be at a pose float64 [4, 4].
    """

    def __init__(
        self,
        after_s: float,
        state: SlamState,
        global_mapping: GlobalMapping,
        make: Callable[[SlamState | None, np.ndarray | None], SegmentSystem],
    ):
        self._after_s, self._state, self._global_mapping, self._make = after_s, state, global_mapping, make
        self._system: SegmentSystem | None = None

    def close(self) -> None:
        """Ends the threads of the segment's system."""
        if self._system is not None:
            self._system.close()
        self._system = None

    def after_frame(self, frame: PreparedFrame, pixels: FramePixels, has_depth: bool) -> np.ndarray | None:
        """Gives the newest frame of the state to the segment; returns where that lies, once it is known.

        Args:
            frame: the newest.
            pixels: its, on the device.
            has_depth: whether enough for a segment to begin with it.

        Returns:
            float64 [4, 4] T_world_segment, with which `join` is to be called; None where there is nothing to join.
        """
        frames = self._state.frames
        segment, number = self._state.segment, len(frames) - 1
        if segment is not None and self._is_over(segment):
            self.end()
            segment = None
        if segment is None:
            is_young = _is_young(self._state)
            after_s = min(self._after_s, YOUNG_AFTER_S) if is_young else self._after_s
            if not has_depth or not frames.is_lost(number) or _lost_s(self._state) < after_s:
                return None
            segment = self._state.segment = self._begun(number, is_young)
        self._system_of(segment).submit(replace(frame, pixels=pixels, requested=None, wait_ms=0.0))
        return self._place(segment)

    def join(self, place: np.ndarray) -> None:
        """Puts the segment's frames and keyframes where they lie in the map, T_world_segment float64 [4, 4]."""
        state, segment = self._state, self._state.segment
        if segment is None:
            raise ValueError("join: there must be a segment")
        inner, rows, own = segment.state, slice(segment.first, None), slice(segment.before, None)
        poses = compose(place, inner.frames.matrices())
        is_new = ~inner.frames.lost
        is_new[own] &= state.frames.lost[rows]
        # The newest frame is known to both.
        gains = inner.frames.gains[own].clone()
        gains[:, 0] += state.frames.gains[-1, 0] - inner.frames.gains[-1, 0]
        state.frames.gains[rows] = gains
        for i in is_new.nonzero()[:, 0].tolist():
            state.frames.poses[segment.number(i)] = pose_tensor(poses[i], state.scene.device)
        state.frames.lost[rows] &= ~is_new[own]
        state.frames.consistent_frames[rows] = 0
        state.pixels.has_pixels[rows] &= inner.pixels.has_pixels[own] | ~is_new[own]
        state.features.insert(
            {segment.number(row): inner.features[i] for i, row in enumerate(inner.features.frames) if is_new[row]}
        )
        self._take_keyframes(segment, poses, is_new)
        state.segment = None
        self.close()

    def end(self) -> None:
        """Gives up on the segment, if there is one; the poses in its own axes are kept."""
        segment = self._state.segment
        if segment is not None:
            self._state.unjoined += _kept_apart(segment.state.frames, segment.number(0))
        self._state.segment = None
        self.close()

    def _take_keyframes(self, segment: Segment, poses: np.ndarray, is_new: torch.Tensor) -> None:
        """Makes the segment's keyframes those of the map; `poses` float64 [F, 4, 4] and `is_new` are of its frames."""
        graph = segment.state.graph
        if graph is None:
            return
        keyframes: list[Keyframe] = []
        links: list[Link] = []
        taken: list[np.ndarray] = []
        before = self._global_mapping.newest_pose()
        for keyframe, link in zip(graph.keyframes, graph.links, strict=True):
            if not is_new[keyframe.frame]:
                continue
            pose = poses[keyframe.frame]
            keyframes.append(
                Keyframe(segment.number(keyframe.frame), keyframe.depth, keyframe.intensity, keyframe.camera)
            )
            links.append(Link(inverse(before) @ pose, link.relocalized or not links))
            taken.append(pose)
            before = pose
        self._global_mapping.take_in(keyframes, links, taken)

    def replace_young_map(self) -> bool:
        """Puts the segment in the place of a map that had hardly begun; the poses of that are kept apart.

        Returns:
            Whether it did: then the state, still the same object, has the segment's content.
        """
        state, segment = self._state, self._state.segment
        if segment is None or not segment.before or not state.frames.is_lost(-1):
            return False
        known, ones = (int((~each.frames.lost).sum()) for each in (state, segment.state))
        if ones < TIMES_AS_MANY * known:
            return False
        unjoined = [*state.unjoined, *_kept_apart(state.frames)]
        vars(state).update(vars(segment.state))
        state.unjoined = unjoined
        return True

    def _begun(self, number: int, may_succeed: bool) -> Segment:
        """A segment that begins with the newest frame, `number`; one that may take the place of the map has the frames
        before it, lost."""
        frames = self._state.frames
        self._system = self._make(None, frames.matrices(-1)[0] if may_succeed else None)
        inner, before = self._system.state, number if may_succeed else 0
        if before:
            earlier = {name: column[:before].clone() for name, column in frames.tensors().items()}
            earlier["lost"][:] = True
            earlier["consistent_frames"][:] = 0
            inner.frames.load_state_dict(earlier)
            for _ in range(before):
                inner.pixels.make_room()
                inner.pixels.add(self._state.pixels.records[0, :0])
        return Segment(number, inner, before)

    def _system_of(self, segment: Segment) -> SegmentSystem:
        if self._system is None:  # the state was loaded
            self._system = self._make(segment.state, None)
        return self._system

    def _is_over(self, segment: Segment) -> bool:
        """Whether the segment itself is lost for as long as makes another begin, or does not fit to the map."""
        inner = segment.state.frames
        tries = int((~self._state.frames.lost[segment.first :]).sum())
        is_lost = len(inner) > segment.before and inner.is_lost(-1)
        return bool(is_lost and _lost_s(segment.state, segment.before) >= self._after_s) or tries > MAX_TRIES

    def _place(self, segment: Segment) -> np.ndarray | None:
        """T_world_segment float64 [4, 4], if the last frames agree on it."""
        inner, outer, count = segment.state.frames, self._state.frames, SETTLED_FRAMES
        if len(inner) - segment.before < count or inner.any_lost(count) or outer.any_lost(count):
            return None
        ones, others = outer.matrices(-count), inner.matrices(-count)
        places = compose(ones, inverse(others))
        moved = compose(inverse(ones), compose(places[-1], others))
        distance = np.linalg.norm(moved[:, :3, 3], axis=1)
        agree = bool((distance < AGREE_M).all()) and bool((rotation_angle(moved[:, :3, :3]) < AGREE_RAD).all())
        return places[-1] if agree else None


def _lost_s(state: SlamState, first: int = 0) -> float:
    """Seconds from the last known frame, or else frame `first`, to the newest.

    Frames of a map that was opened don't count: their clock was another.
    """
    first = max(first, state.frames.opened)
    known, times = (~state.frames.lost[first:]).nonzero(), state.frames.timestamps[first:]
    return float(times[-1] - times[int(known[-1]) if len(known) else 0])


def _kept_apart(frames: FrameTable, first: int = 0) -> list[UnjoinedFrames]:
    """The known frames of a table whose rows are counted from number `first`, if there are any."""
    known = (~frames.lost).nonzero()[:, 0]
    if not len(known):
        return []
    poses = frames.matrices()[known.numpy()]
    moved = matrix_to_pose7(inverse(poses[0]) @ poses)
    return [UnjoinedFrames(first + known, torch.from_numpy(moved).float())]


def _is_young(state: SlamState) -> bool:
    """Whether the map has hardly begun: from its first known frame to the last there is little time."""
    known, times = (~state.frames.lost).nonzero()[:, 0], state.frames.timestamps
    return not state.frames.opened and len(known) > 0 and bool(times[known[-1]] - times[known[0]] < YOUNG_S)
