"""Depth images with fewer rows and columns, where many large ones are looked at together."""

from __future__ import annotations

import math

import numpy as np

from spslam.camera import Camera

# Of a larger depth image only every n-th row and column is kept, so that many of them fit into memory.
_MAX_PIXELS_KEPT = 1 << 19


def thinned(depth: np.ndarray) -> np.ndarray:
    """The rows and columns that are kept of an image [H, W]; a copy where that is not all, so that the whole can go."""
    step = _thinning(*depth.shape)
    return depth if step == 1 else depth[::step, ::step].copy()


def thinned_camera(camera: Camera) -> Camera:
    """The camera of thinned images: pixel (i, j) is pixel (n i, n j) of the whole one."""
    step = _thinning(camera.height, camera.width)
    if step == 1:
        return camera
    width, height = -(-camera.width // step), -(-camera.height // step)
    return Camera(width, height, camera.fx / step, camera.fy / step, camera.cx / step, camera.cy / step)


def _thinning(height: int, width: int) -> int:
    """Every how many rows and columns are kept."""
    return math.ceil(math.sqrt(height * width / _MAX_PIXELS_KEPT))
