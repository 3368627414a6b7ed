"""Poses of color images that are not of the moment of their depth images."""

from dataclasses import dataclass

import numpy as np

from spslam.pose_graph import rotation_matrices, rotation_vectors

MAX_COLOR_DELAY_S = 0.1  # as in csrc/kernels/color_pose.h: a color image farther from its depth image is none of it
MAX_SHARE = 0.8  # of the motion from frame to frame: one image of the next or the last frame
# rad, m, between the two images of a frame, as in csrc/kernels/color_pose.h: what moves on by more has jumped.
MAX_TURN, MAX_DISTANCE = 0.15, 0.15


@dataclass(frozen=True)
class ColorMotion:
    """From the pose at which a frame's depth was measured to that of its color image, on one path.

    Attributes:
        before: float64 [4, 4] T_world_camera of an earlier frame, see `FrameHistory.own_motion`.
        share: of the motion since, which comes on top until the color image; negative where color comes first.
    """

    before: np.ndarray
    share: float

    def color_pose(self, pose: np.ndarray) -> np.ndarray:
        """Pose float64 [4, 4] of the color image of a frame at a pose."""
        return self._moved(pose, 1.0 + self.share)

    def depth_pose(self, color_pose: np.ndarray) -> np.ndarray:
        """The inverse of `color_pose`."""
        return self._moved(color_pose, 1.0 / (1.0 + self.share))

    def _moved(self, pose: np.ndarray, share: float) -> np.ndarray:
        """The pose at a share of the way from the one before to a pose."""
        turn = rotation_vectors(pose[:3, :3] @ self.before[:3, :3].T)
        on_top, distance = abs(share - 1.0), np.linalg.norm(pose[:3, 3] - self.before[:3, 3])
        if on_top * np.linalg.norm(turn) > MAX_TURN or on_top * distance > MAX_DISTANCE:
            return pose
        moved = np.eye(4)
        moved[:3, :3] = rotation_matrices(share * turn) @ self.before[:3, :3]
        moved[:3, 3] = self.before[:3, 3] + share * (pose[:3, 3] - self.before[:3, 3])
        return moved
