"""Frames of a rolling shutter, as of their middle row's moment; see `spslam.ops.rolling_shutter`."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from spslam import ops
from spslam.camera import Camera
from spslam.image_library import image_library
from spslam.slam.depth_keyframes import depth_image_intrinsics, depth_image_shape, depth_unit
from spslam.slam.device_events import read_together
from spslam.slam.image_features import ImageFeatures
from spslam.slam.pixels import FramePixels

if TYPE_CHECKING:
    from spslam.slam.frame_history import FrameHistory
    from spslam.slam.state import SlamState

BENT_PX = 0.5  # by which rows of an image must be off to matter, the first and the last


class ShutterRectifier:
    """Rectifies frames of one camera.

    Args:
        camera: of all frames.
        max_depth_m: the largest depth that images hold.
    """

    def __init__(self, camera: Camera, max_depth_m: float):
        self._unit = depth_unit(max_depth_m)
        self._intrinsics = ops.Intrinsics(camera.fx, camera.fy, camera.cx, camera.cy)
        self._image_intrinsics = depth_image_intrinsics(camera)
        self._size = camera.height, camera.width
        rows, columns = depth_image_shape(camera)
        self._image_rows, self._is_flat = rows, min(rows, columns) < 2  # nothing is between fewer rows

    def seconds(self, state: SlamState, history: FrameHistory, depth_time: float) -> float | None:
        """Since when the camera is known to move to the next frame, s; None where that does not matter.

        Args:
            state: before that frame.
            history: of the state.
            depth_time: when the frame's depth image was taken, s.
        """
        readout, motion = state.noise.readout, history.motion(len(state.frames), depth_time)
        if motion.row < 0 or self._is_flat or (readout.device.type == "cpu" and float(readout) == 0):
            return None
        return motion.seconds

    def predict(
        self, pixels: FramePixels, state: SlamState, seconds: float, steps: float
    ) -> tuple[ops.ShutterMotion, FramePixels]:
        """How the camera is predicted to move, at constant velocity, and the frame with its records rectified by that.

        Without a speed it is predicted to stay, and the records too are as they were read.

        Args:
            pixels: of the frame; images, normals and thumbnail stay as they were read.
            state: before the frame.
            seconds: from the last frame to this one.
            steps: as of `FrameHistory`.
        """
        frames, readout, last = state.frames, state.noise.readout, len(state.frames) - 1
        before = frames.pose_rows[last]
        # A copy of the readout: the frame itself changes the estimate before its features are kept.
        if not frames.knows_speed:
            return ops.ShutterMotion(before, before.clone(), seconds, readout.clone()), pixels
        predicted, readout, records = ops.trusted.predict_frame(
            frames.pose_rows, last, readout, seconds, steps, pixels.records, self._intrinsics, self._size
        )
        return ops.ShutterMotion(before, predicted, seconds, readout), pixels.having(records=records)

    @property
    def bent_turn(self) -> float:
        """As of `Tracker.follow`, rad."""
        return 2 * BENT_PX / self._image_intrinsics.fy  # a readout takes no longer than a frame

    def moving(self, pixels: FramePixels, state: SlamState, seconds: float, steps: float) -> ops.trusted.MovingFrame:
        """A frame as it was read, for `Tracker.follow`; the arguments are those of `predict`."""
        count = len(state.frames)
        return ops.trusted.MovingFrame(
            pixels.records,
            pixels.depth_image,
            pixels.intensity_image,
            state.frames.pose_rows[count - 2 : count],
            state.noise.readout,
            seconds,
            steps,
            self._size,
            self._image_intrinsics,
            self._unit,
        )

    def frame(self, pixels: FramePixels, motion: ops.ShutterMotion) -> FramePixels:
        """The frame with its records and images rectified."""
        records, depth, intensity = ops.trusted.rectify_shutter_frame(
            pixels.records,
            pixels.depth_image,
            pixels.intensity_image,
            motion,
            self._intrinsics,
            self._size,
            self._image_intrinsics,
            self._unit,
        )
        return pixels.having(records=records, depth_image=depth, intensity_image=intensity)

    def bends(self, motion: ops.ShutterMotion, turn_deg: float) -> bool:
        """Whether a frame that was rectified by a motion is bent; may wait for the device.

        Args:
            motion: that motion.
            turn_deg: by how much the camera turned otherwise since the frame before, degrees; NaN bends nothing.
        """
        turn = math.radians(turn_deg)
        return turn > self.bent_turn and turn * abs(float(motion.readout)) > self.bent_turn * motion.seconds

    def features(self, features: ImageFeatures, motion: ops.ShutterMotion) -> ImageFeatures:
        """Image features of the frame as it was read, rectified; waits for the device."""
        if len(features) == 0:
            return features
        *poses, readout = read_together(motion.before, motion.pose, motion.readout)
        if readout[0] == 0:
            return features
        moved = np.array([*np.concatenate(poses), readout[0], motion.seconds], np.float32)
        k = self._image_intrinsics
        camera = np.array([k.fx, k.fy, k.cx, k.cy, self._image_rows], np.float32)
        read = [np.ascontiguousarray(each, np.float32) for each in (features.positions, features.points)]
        positions, points = (np.empty_like(each) for each in read)
        addresses = [each.ctypes.data for each in (*read, moved, camera, positions, points)]
        image_library().spslam_rectify_features(*addresses[:2], len(features), *addresses[2:])
        return replace(features, positions=positions, points=points)
