"""What `ColorToDepth` computes, pixel by pixel in NumPy's float64, for tests: slow, and without what makes it fast."""

from __future__ import annotations

import numpy as np

from spslam.camera import Camera
from spslam.datasets.registration import typical_depth

HIDDEN_SHARE = 0.05


def color_to_depth(
    cameras: tuple[Camera, Camera],
    color_from_depth: np.ndarray,
    color: np.ndarray,
    depth: np.ndarray,
    unseen: np.ndarray | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """Color float64 [H, W, 3] and depth float32 [H, W] in the depth camera's view.

    Args:
        cameras: of color, as large as its image and not finer than depth, and of depth.
        color_from_depth: [4, 4].
        color: uint8 [Hc, Wc, 3].
        depth: float32 [H, W].
        unseen: bool [Hc, Wc], or None.
    """
    camera, depth_camera = cameras
    measured = depth > 0
    with np.errstate(invalid="ignore", divide="ignore"):
        z = np.where(measured, depth, typical_depth(depth)).astype(float)
        points = depth_camera.ray_directions() * z[..., None] @ color_from_depth[:3, :3].T + color_from_depth[:3, 3]
        seen = points[..., 2]
        u = np.where(seen > 0, camera.fx * points[..., 0] / seen + camera.cx, -9.0)
        v = np.where(seen > 0, camera.fy * points[..., 1] / seen + camera.cy, -9.0)
        shows = measured & (u > -0.5) & (v > -0.5) & (u < camera.width - 0.5) & (v < camera.height - 0.5)
    pixel = [np.floor(np.where(shows, axis, 0) + 0.5).astype(int) for axis in (v, u)]
    if color_from_depth[:3, 3].any():
        share = min(1.0, depth_camera.fx / camera.fx)
        size = max(round(share * camera.height), 1), max(round(share * camera.width), 1)
        row, column = (
            ((np.where(shows, at, 0) + 0.5) * cells / pixels).astype(int)
            for at, cells, pixels in ((v, size[0], camera.height), (u, size[1], camera.width))
        )
        nearest = np.full((size[0] + 2, size[1] + 2), np.inf)
        np.minimum.at(nearest, (row[shows] + 1, column[shows] + 1), seen[shows])
        around = [nearest[i : i + size[0], j : j + size[1]] for i in range(3) for j in range(3)]
        shows &= seen * (1 - HIDDEN_SHARE) <= np.min(around, axis=0)[row, column]
    if unseen is not None:
        shows &= ~unseen[tuple(pixel)]
    return interpolated(color, u, v), np.where(shows, depth, np.float32(0))


def interpolated(image: np.ndarray, u: np.ndarray, v: np.ndarray) -> np.ndarray:
    """float64 [h, w, 3]: an image [H, W, 3] between its pixels, repeated beyond its border; NaN counts as 0."""
    height, width = image.shape[:2]
    u, v = np.clip(np.nan_to_num(u), 0, width - 1), np.clip(np.nan_to_num(v), 0, height - 1)
    left, top = u.astype(int), v.astype(int)
    right, bottom = np.minimum(left + 1, width - 1), np.minimum(top + 1, height - 1)
    by_u, by_v = (u - left)[..., None], (v - top)[..., None]
    above = (1 - by_u) * image[top, left] + by_u * image[top, right]
    below = (1 - by_u) * image[bottom, left] + by_u * image[bottom, right]
    return (1 - by_v) * above + by_v * below
