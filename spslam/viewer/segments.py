"""The lines of a run's picture, as segments of colored line, from its frames."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from spslam.camera import Camera
from spslam.viewer.colors import AHEAD, GROUND_TRUTH, KEYFRAME, LOOP, LOST, error_probability_colors
from spslam.viewer.model import RunModel

KEYFRAME_SIZE_M = 0.05


@dataclass(frozen=True)
class Segments:
    """N segments.

    Attributes:
        points: float32 [N, 2, 3], m.
        colors: uint8 [N, 2, 3] RGB.
    """

    points: np.ndarray
    colors: np.ndarray

    @classmethod
    def plain(cls, points: np.ndarray, color: tuple[int, int, int]) -> Segments:
        """Segments of one color."""
        points = np.asarray(points, np.float32).reshape(-1, 2, 3)
        return cls(points, np.full(points.shape, color, np.uint8))

    def __len__(self) -> int:
        return len(self.points)


def path(model: RunModel, shown: int) -> Segments:
    """From each frame to the next where both are tracked, by error probability; F - 1 segments.

    Args:
        model: the frames.
        shown: number of the frame that is shown; later ones are gray.

    Returns:
        One segment per frame but the first, so that a frame's segment stays at its place; of length 0 at lost ones.
    """
    centers, lost = model.poses[:, :3, 3], model.lost
    if len(centers) < 2:
        return Segments.plain(np.zeros((0, 2, 3)), AHEAD)
    points = np.stack([centers[:-1], centers[1:]], axis=1)
    broken = lost[:-1] | lost[1:]
    points[broken, 1] = points[broken, 0]
    colors = error_probability_colors(model.column("error_probability"))
    colors = np.stack([colors[:-1], colors[1:]], axis=1)
    colors[max(shown, 0) :] = AHEAD
    return Segments(points.astype(np.float32), colors)


def lost_stretches(model: RunModel) -> Segments:
    """From the last tracked frame before each lost stretch to the first one after it."""
    known = np.flatnonzero(~model.lost)
    ends = np.flatnonzero(np.diff(known) > 1)
    centers = model.poses[:, :3, 3]
    return Segments.plain(np.stack([centers[known[ends]], centers[known[ends + 1]]], axis=1), LOST)


def keyframes(model: RunModel) -> Segments:
    """A small frustum at each keyframe, of 8 segments."""
    rows = np.flatnonzero((model.column("mapped") > 0) & ~model.lost)
    corners = frustum_corners(model.info.camera) * KEYFRAME_SIZE_M
    edges = [(0, 1), (0, 2), (0, 3), (0, 4), (1, 2), (2, 3), (3, 4), (4, 1)]
    local = np.array([[corners[a], corners[b]] for a, b in edges]).reshape(-1, 3)
    poses = model.poses[rows]
    points = np.einsum("nij,kj->nki", poses[:, :3, :3], local) + poses[:, None, :3, 3]
    return Segments.plain(points, KEYFRAME)


def loops(model: RunModel) -> Segments:
    """From frame to frame of each loop that was closed."""
    centers = model.poses[:, :3, 3]
    ends = [loop for loop in model.loops if min(loop) >= 0 and max(loop) < len(centers)]
    return Segments.plain(centers[np.array(ends, np.int64).reshape(-1, 2)], LOOP)


def ground_truth(model: RunModel) -> Segments:
    """The known path, from frame to frame of the data."""
    poses = model.ground_truth
    if poses is None:
        return Segments.plain(np.zeros((0, 2, 3)), GROUND_TRUTH)
    centers = poses[np.isfinite(poses).all(axis=(1, 2)), :3, 3]
    return Segments.plain(np.stack([centers[:-1], centers[1:]], axis=1), GROUND_TRUTH)


def frustum_corners(camera: Camera) -> np.ndarray:
    """The center and the image's corners one meter in front of it, float64 [5, 3], camera axes."""
    left, right = (-0.5 - camera.cx) / camera.fx, (camera.width - 0.5 - camera.cx) / camera.fx
    top, bottom = (-0.5 - camera.cy) / camera.fy, (camera.height - 0.5 - camera.cy) / camera.fy
    return np.array([[0, 0, 0], [left, top, 1], [right, top, 1], [right, bottom, 1], [left, bottom, 1]], np.float64)
