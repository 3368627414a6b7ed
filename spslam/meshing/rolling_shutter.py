"""Frames of a rolling shutter as of their middle row's moment, for meshes; see `spslam.ops.rolling_shutter`.

While a camera reads a frame out, it moves on: of a Kinect that turns at 60 degrees/s, whose readout is 26 ms, the first
and the last row see 1.6 degrees apart. All poses are known here, so the camera's velocity at a frame is the mean one
from the frame before to the frame after.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch

from spslam import ops
from spslam.camera import Camera
from spslam.datasets.base import RgbdFrame
from spslam.datasets.clock import LEAST_MOTION_S, MAX_MOTION_S
from spslam.geometry import matrix_to_pose7, rotation_angle
from spslam.pose_graph import rotation_matrices, rotation_vectors
from spslam.trajectory import Trajectory

BENT_PX = 1.0  # by which the turn must put the last row off against the first; less is not worth the time
_INTERVAL_S = 1 / 30  # over which velocities are given to the op
_DEPTH_STEPS = 65535


class FrameReadout:
    """How the frames of a dataset are read out.

    Args:
        readout_s: from the first row that is read to the last.
        trajectory: of the frames.
        indices: int64 [F] of the trajectory's frames in the dataset, -1 where they are not there.
    """

    def __init__(self, readout_s: float, trajectory: Trajectory, indices: np.ndarray):
        self._readout = torch.tensor([readout_s], dtype=torch.float32)
        rows = np.flatnonzero((indices >= 0) & ~trajectory.lost).tolist()
        self._moved = {int(indices[row]): moved for row in rows if (moved := _moved(trajectory, row)) is not None}

    def rectified_depth(self, index: int, depth: np.ndarray, camera: Camera) -> np.ndarray:
        """The depth image float32 [H, W], m, of frame `index`; itself where its rows hardly differ."""
        motion = self._motion(index, camera)
        return depth if motion is None else _rectified(depth, [], motion, camera)[0]

    def rectified(self, index: int, frame: RgbdFrame, camera: Camera) -> RgbdFrame:
        """Frame `index`; itself where its rows hardly differ."""
        motion = self._motion(index, camera)
        if motion is None:
            return frame
        channels = [np.ascontiguousarray(frame.color[..., channel]) for channel in range(frame.color.shape[-1])]
        depth, channels = _rectified(frame.depth, channels, motion, camera)
        return replace(frame, depth=depth, color=np.stack(channels, axis=-1))

    def _motion(self, index: int, camera: Camera) -> ops.ShutterMotion | None:
        """How the camera moves at frame `index`; None where that is not known or bends it too little."""
        moved = self._moved.get(index)
        if moved is None or min(camera.height, camera.width) < 2:
            return None
        before, pose = moved
        turn = rotation_angle(before[:3, :3].T @ pose[:3, :3]) * abs(float(self._readout)) / _INTERVAL_S
        if turn * max(camera.fx, camera.fy) < BENT_PX:
            return None
        poses = torch.from_numpy(matrix_to_pose7(np.stack([before, pose])).astype(np.float32))
        return ops.ShutterMotion(poses[0], poses[1], _INTERVAL_S, self._readout)


def _moved(trajectory: Trajectory, row: int) -> tuple[np.ndarray, np.ndarray] | None:
    """Where the camera was `_INTERVAL_S` before a frame, by its velocity then, and where it is; None if that is not
    known."""
    times, poses = trajectory.timestamps, trajectory.poses
    near = [other for other in (row - 1, row + 1) if 0 <= other < len(times) and not trajectory.lost[other]]
    near = [other for other in near if LEAST_MOTION_S <= abs(times[other] - times[row]) < MAX_MOTION_S]
    first, last = min([*near, row]), max([*near, row])
    seconds = times[last] - times[first]
    if seconds <= 0:  # none is near, or stamps go back
        return None
    share = _INTERVAL_S / seconds
    before = poses[row].copy()
    turn = rotation_vectors(poses[last][:3, :3] @ poses[first][:3, :3].T)
    before[:3, :3] = rotation_matrices(-share * turn) @ poses[row][:3, :3]
    before[:3, 3] -= share * (poses[last][:3, 3] - poses[first][:3, 3])
    return before, poses[row]


def _rectified(
    depth: np.ndarray, channels: list[np.ndarray], motion: ops.ShutterMotion, camera: Camera
) -> tuple[np.ndarray, list[np.ndarray]]:
    """Depth float32 [H, W], m, and channels uint8 [H, W] of a color image; the op takes one channel, and depth each
    time."""
    unit = max(float(depth.max()), 1e-3) / _DEPTH_STEPS
    read = torch.from_numpy((depth / np.float32(unit) + np.float32(0.5)).astype(np.uint16))
    intrinsics = ops.Intrinsics(camera.fx, camera.fy, camera.cx, camera.cy)
    moved, made = torch.empty_like(read), []
    for channel in channels or [np.zeros(depth.shape, np.uint8)]:
        image = torch.from_numpy(channel)
        out = torch.empty_like(image)
        ops.trusted.rectify_shutter_images_(moved, out, read, image, motion, intrinsics, unit)
        made.append(out.numpy())
    return moved.numpy().astype(np.float32) * np.float32(unit), made
