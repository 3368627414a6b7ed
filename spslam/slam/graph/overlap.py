"""Which keyframes see the same surface, by their depth thumbnails."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from spslam.slam.graph.keyframe import MIN_DEPTH_M, Keyframe, KeyframeCamera
from spslam.slam.recovery.free_space import TOLERANCE_M, TOLERANCE_SHARE

SURFACE_TOLERANCES = 2.0  # of `free_space`, as poses may have drifted


@dataclass(frozen=True)
class _Points:
    """Surface points [n, 3] of a keyframe in its axes, their center [3] and RMS distance from it, m."""

    points: np.ndarray
    center: np.ndarray
    radius: float

    @classmethod
    def of(cls, keyframe: Keyframe) -> _Points:
        """Those of its depth thumbnail."""
        depth = keyframe.thumbnail.numpy()
        row, column = np.nonzero(depth)
        k, step, z = keyframe.camera.camera, keyframe.camera.thumbnail_step, depth[row, column].astype(np.float64)
        u, v = column * step + step // 2, row * step + step // 2
        points = np.stack([(u - k.cx) / k.fx * z, (v - k.cy) / k.fy * z, z], 1)
        if not len(points):
            return cls(points, np.zeros(3), 0.0)
        center = points.mean(0)
        return cls(points, center, float(np.sqrt(((points - center) ** 2).sum(1).mean())))


class Surfaces:
    """Depth thumbnails of keyframes, as images and as points; of one camera or of several."""

    def __init__(self) -> None:
        self._cameras: list[KeyframeCamera] = []
        self._thumbnails: list[np.ndarray] = []
        self._medians: list[float] = []
        self._points: list[_Points] = []
        self._centers = np.zeros((0, 3))
        self._radii = np.zeros(0)

    def __len__(self) -> int:
        return len(self._points)

    def add(self, keyframe: Keyframe) -> None:
        """Appends a keyframe's."""
        points = _Points.of(keyframe)
        self._cameras.append(keyframe.camera)
        self._thumbnails.append(keyframe.thumbnail.numpy())
        self._medians.append(keyframe.median_m)
        self._points.append(points)
        self._centers = np.concatenate([self._centers, points.center[None]])
        self._radii = np.append(self._radii, points.radius)

    def keep(self, kept: np.ndarray) -> None:
        """Forgets the others of the first K keyframes; bool [K]."""
        rows = [row for row in range(len(self)) if row >= len(kept) or kept[row]]
        self._cameras, self._medians = [self._cameras[row] for row in rows], [self._medians[row] for row in rows]
        self._thumbnails, self._points = [self._thumbnails[row] for row in rows], [self._points[row] for row in rows]
        self._centers, self._radii = self._centers[rows], self._radii[rows]

    def median_m(self, one: int) -> float:
        """Median depth of a keyframe; infinite where none is known."""
        return self._medians[one]

    def overlaps(self, one: int, poses: np.ndarray) -> np.ndarray:
        """Shares float64 [K] of the surface of keyframe `one` that each of the first K sees from its pose [4, 4]."""
        return self._shares(self._points[one], poses[one], poses)

    def overlaps_of(self, keyframe: Keyframe, pose: np.ndarray, poses: np.ndarray) -> np.ndarray:
        """The same for a keyframe that need not be one of them, at a pose [4, 4]."""
        return self._shares(_Points.of(keyframe), pose, poses)

    def _shares(self, one: _Points, pose: np.ndarray, poses: np.ndarray) -> np.ndarray:
        shares = np.zeros(len(poses))
        if len(one.points):
            near, seen = self._seen_from(one, pose, np.arange(len(poses)), poses)
            shares[near] = seen.mean(1)
        return shares

    def covered(self, one: int, others: np.ndarray, poses: np.ndarray) -> float:
        """Share of the surface of keyframe `one` that others, int64 [C], see together; 1 where it has none."""
        points = self._points[one]
        if not len(points.points):
            return 1.0
        return float(self._seen_from(points, poses[one], others, poses)[1].any(0).mean())

    def _seen_from(
        self, one: _Points, pose: np.ndarray, others: np.ndarray, poses: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Those of others that are near enough to see surface of a pose [4, 4], and which points they see [C, n]."""
        centers = np.einsum("kij,kj->ki", poses[:, :3, :3], self._centers[: len(poses)]) + poses[:, :3, 3]
        distance = np.linalg.norm(centers[others] - (pose[:3, :3] @ one.center + pose[:3, 3]), axis=1)
        near = others[distance < self._radii[others] + one.radius]
        world = one.points @ pose[:3, :3].T + pose[:3, 3]
        local = np.einsum("knj,kji->kni", world - poses[near, None, :3, 3], poses[near, :3, :3])
        seen = np.zeros(local.shape[:2], bool)
        for camera in dict.fromkeys(self._cameras[row] for row in near.tolist()):
            of_it = np.array([self._cameras[row] == camera for row in near.tolist()])
            seen[of_it] = self._seen(near[of_it], local[of_it], camera)
        return near, seen

    def _seen(self, rows: np.ndarray, points: np.ndarray, camera: KeyframeCamera) -> np.ndarray:
        """Which of points [C, n, 3] in the axes of keyframes of one camera lie on the surface these see, [C, n]."""
        thumbnails = np.stack([self._thumbnails[row] for row in rows])
        (height, width), k, step = thumbnails.shape[1:], camera.camera, camera.thumbnail_step
        x, y, z = np.moveaxis(points, 2, 0)
        safe = np.where(z > MIN_DEPTH_M, z, 1.0)
        column = np.floor((x / safe * k.fx + k.cx) / step)
        row = np.floor((y / safe * k.fy + k.cy) / step)
        inside = (z > MIN_DEPTH_M) & (column >= 0) & (column < width) & (row >= 0) & (row < height)
        at = np.where(inside, row, 0).astype(np.int64), np.where(inside, column, 0).astype(np.int64)
        depth = thumbnails[np.arange(len(rows))[:, None], at[0], at[1]]
        tolerance = SURFACE_TOLERANCES * (TOLERANCE_M + TOLERANCE_SHARE * z)
        return inside & (depth > 0) & (np.abs(depth - z) < tolerance)
