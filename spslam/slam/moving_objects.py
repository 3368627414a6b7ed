"""What moves before the camera, such as people, is left out of a frame, and does not lead the camera along.

A pixel moves if frames of the last two seconds saw free space where its surface is, or if it lies behind surface that
they saw and that is gone (`ops.comparison.find_moving_cells`). That is looked for where frames were tracked, as where
they were predicted surface of a camera that shakes seems to move. Something large may lead tracking along; then poses
are wrong by which that is judged. So while anything moves, the camera is predicted by what most image features agree
on, and what moves is found before the frame is tracked.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import torch

from spslam import ops
from spslam.camera import Camera
from spslam.config import Config
from spslam.slam.depth_history import WATCHED_S, DepthHistory
from spslam.slam.depth_keyframes import depth_image_intrinsics, depth_image_step, depth_unit
from spslam.slam.device_events import DeviceEvent, event_recorder, fetch
from spslam.slam.feature_store import uses_features
from spslam.slam.frame_history import COLOR_MOTION_S, FrameHistory
from spslam.slam.frame_table import FrameTable
from spslam.slam.image_features import FrameFeatures
from spslam.slam.pixels import THUMBNAIL_STEP_PX, FramePixels
from spslam.slam.prepared_frame import PreparedFrame
from spslam.slam.recovery.feature_alignment import FeatureAlignment, joined_too
from spslam.slam.recovery.tracked_frame import TrackedFrame
from spslam.slam.rolling_shutter import ShutterRectifier
from spslam.slam.row_copies import RowCopies
from spslam.slam.state import SlamState
from spslam.slam.tracker import Tracker

# Depths differ if they do by more than this, so many deviations of depth, and so many times what the motion model's
# prediction was off of late, where the camera is predicted by that.
MARGIN_M, DEVIATIONS, TIMES_OFF = 0.02, 4.0, 2.0
NOTICED = 0.01  # share of the cells with depth; fewer are noise at edges
# Where the share is between these, the pixels are left out. Most of the image moves only where the camera is not where
# it was predicted.
LEAST, MOST = 0.02, 0.5
FEWEST_PIXELS = 100  # that must remain
MOST_MAPPED = 0.3  # where more moves, some of it may not be known to, and the frame is not mapped
WATCHED_EVERY = 3  # frames; of those in which nothing has moved
# The camera is predicted by features of frames of about these ages, s, at most `WATCHED_S`, if so many agree with
# one pose, and that share of all that match.
AGES_S = (0.33, 0.83, 1.67)
MIN_AGREEING, MIN_AGREEING_SHARE = 40, 0.4
MORE_AGREEING = 1.25  # times as many as with the pose that motion predicts
NOT_OFF = (0.0, 0.0)


class StaticFrame(NamedTuple):
    """A frame without what moves.

    Attributes:
        features: of the frame as it was read; their pixels are those that do not move.
        start: float32 [7], where most of the image says that the camera is; None where nobody asked, or none does.
        is_watched: whether something has moved of late.
        found: int32 [2] how many cells move, and how many have depth, on its way to the CPU; None where nobody looked.
    """

    features: FrameFeatures
    start: torch.Tensor | None = None
    is_watched: bool = False
    found: torch.Tensor | None = None


class MovingObjects:
    """Finds what moves in one frame after the other.

    What was found in a frame is read when the next one comes, so that the host does not wait for the device. Till then
    the state has it, as a checkpoint may come between.

    Args:
        config: options of the run.
        camera: of all frames.
        tracker: predicts poses.
        rectifier: of frames that a rolling shutter bends; None where none is measured.
    """

    def __init__(self, config: Config, camera: Camera, tracker: Tracker, rectifier: ShutterRectifier | None):
        self._camera, self._tracker, self._rectifier = camera, tracker, rectifier
        self._unit = depth_unit(config.dataset.max_depth_m)
        self._image_step = depth_image_step(camera)
        self._uses_features = uses_features(config)
        self._coming: tuple[DeviceEvent, torch.Tensor] | None = None  # what was found, on its way from the device

    def forget(self) -> None:
        """Another state follows."""
        self._coming = None

    def without(
        self, state: SlamState, history: FrameHistory, frame: PreparedFrame, features: FrameFeatures
    ) -> StaticFrame:
        """The next frame without what moves in it.

        Args:
            state: before the frame; when something moved last is noted in it.
            history: the frames before.
            frame: the next one.
            features: of it, as it was read.
        """
        known = state.depth_history
        if known is None or history.is_lost or not features.pixels.count:
            return StaticFrame(features)
        self._note(known)
        if not self._is_watched(known, history):
            return StaticFrame(features)
        predicted, start = self._tracker.predict(state.frames, history.steps), None
        shutter = self._predicted_shutter(state, history, frame, predicted)
        if self._uses_features:
            start = self._by_features(state.frames.opened, history, frame, features, predicted, shutter)
        pose, off = (predicted, known.off) if start is None else (start, NOT_OFF)
        cells = self._cells(features.pixels, known.step, shutter)
        found = self._look(state.frames, known, history, cells, pose, off)
        if found is None:
            return StaticFrame(features, is_watched=True)
        left = features.having(self._left_out(features, known.step, *found))
        return StaticFrame(left, start, is_watched=True, found=self._fetched(known, len(state.frames), found[1]))

    def judged(self, static: StaticFrame, tracked: TrackedFrame) -> TrackedFrame:
        """What tracking made of a frame, occluded where too much of it moves; the device looked before it tracked.

        A frame that was recovered is elsewhere than it was looked at from.
        """
        if static.found is None or self._coming is None or tracked.occluded or tracked.recovered:
            return tracked
        self._coming[0].wait()
        moving, known = static.found.tolist()
        return replace(tracked, occluded=True) if moving > MOST_MAPPED * known else tracked

    def keep(
        self,
        state: SlamState,
        history: FrameHistory,
        read: FramePixels,
        static: StaticFrame,
        shutter: ops.ShutterMotion | None,
        tracked: TrackedFrame,
        copies: RowCopies,
    ) -> torch.Tensor | None:
        """Keeps what later frames need of the newest one of a state, at a trusted pose, and looks for what moves.

        Args:
            state: after the frame; changed.
            history: the frames before.
            read: its pixels as they were read.
            static: those that do not move.
            shutter: by which the frame was rectified; None where it was not.
            tracked: what tracking made of it.
            copies: what is stored is written when these are made.

        Returns:
            `StaticFrame.found`, of this look or of that before tracking.
        """
        known, number, counts = state.depth_history, len(state.frames) - 1, static.found
        if known is None or tracked.lost:
            return counts
        off = tracked.fit.prediction_error_cm / 100, math.radians(tracked.fit.prediction_error_deg)
        if static.start is None and not math.isnan(sum(off)):
            known.predicted(*off)
        last = max(known.frames)
        seconds = state.frames.depth_time(number) - state.frames.depth_time(last) if last >= 0 else 0.0
        is_looked_at = not static.is_watched and number % WATCHED_EVERY == 0
        is_kept = known.takes(number, seconds)
        if not (is_looked_at or is_kept):
            return counts
        cells = self._cells(read, known.step, shutter)
        if is_looked_at:
            found = self._look(state.frames, known, history, cells, tracked.pose, NOT_OFF)
            counts = None if found is None else self._fetched(known, number, found[1])
        if is_kept:
            known.keep(number, cells, copies)
        return counts

    def _predicted_shutter(
        self, state: SlamState, history: FrameHistory, frame: PreparedFrame, predicted: torch.Tensor
    ) -> ops.ShutterMotion | None:
        """By which the next frame is bent where the camera goes on as it came; None where that is not known."""
        frames, seconds = state.frames, None
        if self._rectifier is not None and frames.knows_speed:
            seconds = self._rectifier.seconds(state, history, frame.depth_time)
        if seconds is None:
            return None
        return ops.ShutterMotion(frames.pose_rows[len(frames) - 1], predicted, seconds, state.noise.readout)

    def _cells(self, pixels: FramePixels, step: int, shutter: ops.ShutterMotion | None) -> torch.Tensor:
        """Depth uint16 [h, w] of a frame as it was read, every step-th pixel, rectified."""
        cells = pixels.depth_image[::step, ::step].contiguous()
        if shutter is None or min(cells.shape) < 2:
            return cells
        rectified, gray = torch.empty_like(cells), torch.zeros_like(cells, dtype=torch.uint8)  # colors are not asked
        ops.trusted.rectify_shutter_images_(
            rectified, torch.empty_like(gray), cells, gray, shutter, self._cell_intrinsics(step), self._unit
        )
        return rectified

    def _cell_intrinsics(self, step: int) -> ops.Intrinsics:
        return ops.Intrinsics(*(each / step for each in depth_image_intrinsics(self._camera)))

    def _is_watched(self, known: DepthHistory, history: FrameHistory) -> bool:
        return known.moving >= 0 and 0 <= history.seconds_since(known.moving) <= WATCHED_S

    def _look(
        self,
        frames: FrameTable,
        known: DepthHistory,
        history: FrameHistory,
        cells: torch.Tensor,
        pose: torch.Tensor,
        off: tuple[float, ...],
    ) -> tuple[torch.Tensor, torch.Tensor] | None:
        """Cells and counts of `ops.comparison.find_moving_cells` for depth in cells at a pose that may be off by so
        much, m and radians; None where no earlier frame tells."""
        earlier = known.known(frames.is_lost, history.seconds_since)
        if not earlier:
            return None
        off_m, off_rad = off
        margins = MARGIN_M + TIMES_OFF * off_m, TIMES_OFF * off_rad, DEVIATIONS
        return ops.comparison.find_moving_cells(
            cells,
            pose,
            (known.cells, frames.pose_rows, earlier),
            history.noise,
            ops.comparison.DepthCells(self._cell_intrinsics(known.step), self._unit, 1, *margins),
        )

    def _fetched(self, known: DepthHistory, number: int, counts: torch.Tensor) -> torch.Tensor:
        """Counts of a look at frame `number` on their way to the CPU; they are noted when the next frame comes."""
        known.looked, known.found = number, counts
        coming = fetch(counts)
        self._coming = event_recorder(counts.device)(), coming
        return coming

    def _note(self, known: DepthHistory) -> None:
        """Reads what was found in the frame before; it was copied before that frame was mapped, and is there by now."""
        if known.looked < 0:
            return
        found = known.found
        if self._coming is not None:
            self._coming[0].wait()
            found = self._coming[1]
        moving, all_cells = found.tolist()
        if moving > NOTICED * all_cells:
            known.moving = known.looked
        known.looked, self._coming = -1, None

    def _left_out(
        self, features: FrameFeatures, step: int, cells: torch.Tensor, counts: torch.Tensor
    ) -> dict[str, torch.Tensor]:
        """The frame as it was read without what lies in cells that move. These are of the rectified frame: in a rolling
        shutter's turn the first and last rows are some pixels beside them."""
        pixels = features.pixels
        names = ("records", "normals", "depth_image", "depth_thumbnail")
        steps = ops.comparison.SampleSteps(self._image_step, THUMBNAIL_STEP_PX, step)
        tensors = ops.comparison.leave_out_moving(
            tuple(getattr(pixels, name) for name in names), cells, counts, steps, (LEAST, MOST), FEWEST_PIXELS
        )
        return dict(zip(names, tensors, strict=True))

    def _by_features(
        self,
        first: int,
        history: FrameHistory,
        frame: PreparedFrame,
        features: FrameFeatures,
        predicted: torch.Tensor,
        shutter: ops.ShutterMotion | None,
    ) -> torch.Tensor | None:
        """Pose float32 [7] that most features agree on with frames of the last two seconds, from number `first` on;
        None where too few do, or nearly as many with the one that motion predicts."""
        rows = self._anchors(first, history)
        known = {row: kept for row in rows if (kept := history.features(row)) is not None and len(kept)}
        if not known:
            return None
        read = rectified = features.extracted
        if shutter is not None and self._rectifier is not None:
            rectified = self._rectifier.features(read, shutter)
        motion = None
        if self._rectifier is not None:
            came = history.motion(len(history.poses), frame.depth_time, frame.offsets.color, COLOR_MOTION_S)
            motion = history.color_motion(came)
        image = FeatureAlignment(rectified, self._camera, motion, read, history.poses.device)
        poses = history.color_poses(list(known), is_timed=self._rectifier is not None)
        matches = max(joined_too(image.matches_with(list(zip(known.values(), poses, strict=True)))), key=len)
        pose = image.pose(matches, history.poses.device) if len(matches) >= MIN_AGREEING else None
        if pose is None:
            return None
        agreeing, of_motion = (image.inliers(matches, image.color_pose(each)) for each in (pose, predicted))
        least = max(MIN_AGREEING, MIN_AGREEING_SHARE * len(np.unique(matches.rows)), MORE_AGREEING * of_motion)
        return pose if agreeing >= least else None

    @staticmethod
    def _anchors(first: int, history: FrameHistory) -> list[int]:
        """Rows, from `first` on, of the frames with image features whose ages are nearest to `AGES_S`."""
        ages = {row: history.seconds_since(row) for row in history.feature_rows()[-60:] if row >= first}
        ages = {row: age for row, age in ages.items() if 0.5 * AGES_S[0] <= age <= WATCHED_S}
        return sorted({min(ages, key=lambda row: abs(ages[row] - wanted)) for wanted in AGES_S}) if ages else []
