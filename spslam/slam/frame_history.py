"""Read access to earlier frames, for tracking and recovery."""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch

from spslam import ops
from spslam.datasets.clock import LEAST_MOTION_S, MAX_MOTION_S
from spslam.geometry import pose7_to_matrix
from spslam.slam.color_motion import MAX_COLOR_DELAY_S, MAX_SHARE, ColorMotion
from spslam.slam.device_events import read_together
from spslam.slam.image_features import ImageFeatures
from spslam.slam.state import SlamState

MAX_COMPARED = 128  # frames that a pose is verified against: the most recent and an even sample of the others
RECENT_COMPARED = 16
UNEVEN_STEPS = 1.4  # times between frames differ by less where they are of one rate, and stamps are late or early
MAX_STEPS = 4.0
# At least between the two that say where a color image was taken. What a pose is off by moves the color image that the
# next one is found by: with color half of that time before depth it would be off as much to the other side, and with
# more than half farther and farther (docs/experiments/2026-11-color-before-depth.md).
COLOR_MOTION_S = 0.025


@dataclass(frozen=True)
class EarlierFrame:
    """An earlier frame with a trusted pose.

    Attributes:
        records: int32 [P, 3] its packed pixels in random order.
        pose: float32 [7] T_world_camera.
    """

    records: torch.Tensor
    pose: torch.Tensor


class FrameHistory:
    """Read access to the frames of a state, always in their current version.

    Args:
        state: of the system; not changed.

    Attributes:
        coming_s: when the depth image of the frame that is localized was taken, s; minus infinity where that is not
            known.
    """

    def __init__(self, state: SlamState):
        self._state = state
        self.coming_s = -math.inf

    @property
    def is_lost(self) -> bool:
        """Whether the last frame is lost."""
        return self._state.frames.is_lost(-1)

    @property
    def knows_speed(self) -> bool:
        """Whether the last two frames' poses are trusted."""
        return self._state.frames.knows_speed

    @property
    def consistent_frames(self) -> int:
        """How many of the last frames are lost, but have likely poses that are consistent with one another."""
        return int(self._state.frames.consistent_frames[-1])

    @property
    def consecutive_lost_frames(self) -> int:
        """How many frames at the end are lost."""
        known = (~self._state.frames.lost).nonzero()
        return len(self._state.frames) - (int(known[-1]) + 1 if len(known) else 0)

    @property
    def interval_s(self) -> float:
        """From the last frame to the one that is localized, s; 0 where that is not known."""
        frames = self._state.frames
        return max(self.coming_s - frames.depth_time(len(frames) - 1), 0.0)

    @property
    def steps(self) -> float:
        """`interval_s`, in times between the last two frames: 1 where these are even, or not known.

        So far the camera is predicted to go on. At most `MAX_STEPS`, as no camera keeps its speed for long.
        """
        frames, interval = self._state.frames, self.interval_s
        if interval == 0 or len(frames) < 2:
            return 1.0
        before = frames.depth_time(len(frames) - 1) - frames.depth_time(len(frames) - 2)
        if before <= 0:
            return 1.0
        steps = interval / before
        return 1.0 if 1 / UNEVEN_STEPS < steps < UNEVEN_STEPS else min(steps, MAX_STEPS)

    def seconds_since(self, row: int) -> float:
        """From the frame in a row to the one that is localized, s.

        Where nobody says when that comes, it comes as long after the last one as that after the one before. Infinite
        where that is not known: with one frame only, or where time does not go on.
        """
        times, interval = self._state.frames.depth_times, self.interval_s
        if interval == 0 and len(times) > 1:
            interval = float(times[-1] - times[-2])
        since = float(times[-1] - times[row])
        return since + interval if interval > 0 and since >= 0 else math.inf

    @property
    def poses(self) -> torch.Tensor:
        """float32 [F, 7] of all frames, on the device."""
        return self._state.frames.poses

    @property
    def records(self) -> torch.Tensor:
        """int32 [F, P, 3] packed pixels of all frames, on the device."""
        return self._state.pixels.records

    @property
    def depth_thumbnails(self) -> torch.Tensor:
        """float16 [F, h, w] depth thumbnails (m) of all frames, 0 where unknown, on the device."""
        return self._state.frames.depth_thumbnails

    def frame(self, row: int) -> EarlierFrame:
        """The frame in a row of the frame table."""
        return EarlierFrame(self._state.pixels.records[row], self._state.frames.poses[row])

    def last(self) -> EarlierFrame | None:
        """The last frame with pixels and a trusted pose; None where there is none."""
        row = self.last_row()
        return None if row is None else self.frame(row)

    def last_row(self) -> int | None:
        """Row of the last frame with pixels and a trusted pose; None where there is none."""
        usable = np.flatnonzero(self._state.usable.numpy())
        return int(usable[-1]) if len(usable) else None

    def last_mapped(self, every: int) -> tuple[int, EarlierFrame] | None:
        """The newest frame with a trusted pose that mapping took, given that it takes every n-th, and its number."""
        has_pixels, lost = self._state.pixels.pixel_flags, self._state.frames.lost_flags
        for row in range((len(lost) - 1) // every * every, -1, -every):
            if has_pixels[row] and not lost[row]:
                return row, self.frame(row)
        return None

    @property
    def noise(self) -> torch.Tensor:
        """float32 [4] what was measured of the sensor's noise, on the device; see `ops.SensorNoise`."""
        return self._state.noise.model

    def depth_keyframes(self, depth_time: float | None = None, color_offset: float = 0.0) -> ops.DepthKeyframes | None:
        """Earlier images to align the next frame with, its times as of `motion`; None if none has a trusted pose."""
        state = self._state
        if state.depth_keyframes is None:
            return None
        frames = state.frames
        selected = state.depth_keyframes.select(len(frames), frames.is_lost, frames.pose_rows)
        if selected is None:
            return None
        motions = tuple(self.own_motion(row) for _, row in selected.rows)
        motion = self.motion(len(frames), depth_time, color_offset, COLOR_MOTION_S)
        timing = ops.ColorTiming(state.noise.color_delay, motions, motion, state.depth_keyframes.readouts)
        exposure = ops.Exposure(frames.log_gain_rows, frames.gains[-1])
        return selected._replace(timing=timing, exposure=exposure)

    def log_gain(self, row: int) -> torch.Tensor:
        """float32 [1] of the frame in a row, see `ops.Exposure`, on the device."""
        return self._state.frames.log_gain_rows[row]

    def own_motion(self, row: int) -> ops.FrameMotion:
        """How the camera came to the frame of a row, from one `COLOR_MOTION_S` before: this places its color image."""
        frames = self._state.frames
        return self.motion(row, frames.depth_time(row), frames.color_offset(row), COLOR_MOTION_S)

    def motion(
        self, row: int, depth_time: float | None, color_offset: float = 0.0, least_s: float = 0.0
    ) -> ops.FrameMotion:
        """How the camera came to the frame of a row, or to the next one, from the frame before.

        Args:
            row: of the frame.
            depth_time: when its depth image was taken, s; None where that is not known.
            color_offset: from there to its color image, s, as stamps say.
            least_s: from a frame that is older by so much, if those between are trusted.
        """
        frames = self._state.frames
        if depth_time is None or row <= frames.opened or frames.is_lost(row - 1):
            return ops.NO_MOTION
        before, seconds = row - 1, depth_time - frames.depth_time(row - 1)
        while 0 < seconds < least_s and before > frames.opened and not frames.is_lost(before - 1):
            before -= 1
            seconds = depth_time - frames.depth_time(before)
        return (
            ops.FrameMotion(before, seconds, color_offset)
            if LEAST_MOTION_S <= seconds < MAX_MOTION_S
            else ops.NO_MOTION
        )

    def color_motion(self, motion: ops.FrameMotion) -> ColorMotion | None:
        """How a frame's color image moved on from its depth image; None where the two are of one moment, or nothing
        is known of the motion. Waits for the device."""
        delay, before = read_together(self._state.noise.color_delay, self.poses[max(motion.row, 0)])
        return _color_motion(motion, float(delay[0]), before)

    def color_poses(self, rows: Sequence[int], is_timed: bool = True) -> list[np.ndarray]:
        """float64 [4, 4] where the camera took the color images of the frames in rows. Waits for the device, once.

        Args:
            rows: of the frames.
            is_timed: whether color images are taken to be of other moments than depth images.
        """
        if not is_timed:
            at_depth = read_together(*(self.poses[row] for row in rows))
            return [pose7_to_matrix(pose.astype(np.float64)) for pose in at_depth]
        motions = [self.own_motion(row) for row in rows]
        poses, before = [self.poses[row] for row in rows], [self.poses[max(motion.row, 0)] for motion in motions]
        delay, *numbers = read_together(self._state.noise.color_delay, *poses, *before)
        found = []
        for pose, motion, earlier in zip(numbers, motions, numbers[len(rows) :], strict=False):
            matrix = pose7_to_matrix(pose.astype(np.float64))
            moved = _color_motion(motion, float(delay[0]), earlier)
            found.append(matrix if moved is None else moved.color_pose(matrix))
        return found

    def features(self, row: int) -> ImageFeatures | None:
        """Image features of the frame in a row, if they are kept or its images still are; may wait for the device."""
        store, newest = self._state.features, self._state.newest
        if newest is not None and row == newest.number:
            return newest.features()  # all of them, with positions
        return store[store.frames.index(row)] if row in store.frames else None

    def feature_rows(self) -> list[int]:
        """Rows of the frames with a trusted pose whose image features are kept, ascending."""
        usable = self._state.usable
        return [row for row in self._state.features.frames if usable[row]]

    def usable_rows(self) -> torch.Tensor:
        """int64 on the CPU, ascending: frames that have pixels and a trusted pose."""
        return self._state.usable.nonzero()[:, 0]

    def compared_rows(self) -> torch.Tensor:
        """int64 on the device: the usable frames that a pose is verified against, at most `MAX_COMPARED`."""
        rows = self.usable_rows()
        if len(rows) > MAX_COMPARED:
            older = torch.linspace(0, len(rows) - RECENT_COMPARED - 1, MAX_COMPARED - RECENT_COMPARED).long()
            rows = torch.cat([rows[older], rows[-RECENT_COMPARED:]])
        device = self._state.frames.poses.device
        return rows if device.type == "cpu" else rows.pin_memory().to(device, non_blocking=True)


def _color_motion(motion: ops.FrameMotion, delay_s: float, before: np.ndarray) -> ColorMotion | None:
    """`FrameHistory.color_motion` from the pose float32 [7] of the frame that the motion begins at."""
    delay_s += motion.color_offset
    share = delay_s / motion.seconds
    if motion.row < 0 or delay_s == 0 or abs(delay_s) > MAX_COLOR_DELAY_S or abs(share) > MAX_SHARE:
        return None
    return ColorMotion(pose7_to_matrix(before.astype(np.float64)), share)
