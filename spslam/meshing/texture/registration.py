"""Moves color images to where the others have the surface, by some pixels.

The poses are those of depth images. Color may be taken later, be read out row by row, or come from a camera whose place
is not known well; each of these moves a whole image nearly affinely. A sharp mean needs images that agree to a pixel.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from spslam.camera import Camera
from spslam.meshing.texture.bake import sample
from spslam.meshing.texture.views import ColorView

# Blurs of the image in turn, px: the first finds large shifts, the last one exact ones; steps with each.
_SIGMAS_PX, _STEPS = (4.0, 2.0, 1.0), 4
_MOST_POINTS, _LEAST_POINTS = 12_000, 300
# Differences of gray levels count half from here on: highlights, and what is hidden.
_SCALE = 12.0
# A shift by so many pixels, or a stretch by so many over half an image, is taken if so many points with a slope of ten
# levels per pixel say so.
_PRIOR_PX, _PRIOR_POINTS, _PRIOR_SLOPE = 2.0, 30.0, 10.0
# Gray values within so many levels tell nothing.
_LEAST_SPREAD = 4.0
# Beyond this no image is off; what says so is another surface.
_MOST_PX = 20.0


@dataclass(frozen=True)
class _Points:
    """Surface points that a frame sees.

    Attributes:
        u, v: float32 [N], where they fall by the pose, px.
        basis: float64 [N, 3]: 1, and u and v from -1 to 1 over the larger side of the image.
        gray: float64 [N], the gray values that are wanted, 0 to 255.
    """

    u: np.ndarray
    v: np.ndarray
    basis: np.ndarray
    gray: np.ndarray


class MeanGray:
    """Gray values of surface points, as they are known so far.

    Args:
        colors: uint8 [V, 3], colors that the points are known to have, not sharp.

    Attributes:
        gray: float32 [V], of these colors.
    """

    def __init__(self, colors: np.ndarray) -> None:
        self.gray = cv2.cvtColor(colors[None], cv2.COLOR_RGB2GRAY)[0].astype(np.float32).reshape(-1)
        self._sums = np.zeros((2, len(self.gray)))

    def add(self, view: ColorView, ids: np.ndarray, places: np.ndarray, weights: np.ndarray) -> None:
        """Takes in what a frame has at points `ids` [N], which fall at homogeneous pixel coordinates [N, 3]."""
        gray = cv2.cvtColor(view.frame.color, cv2.COLOR_RGB2GRAY)[..., None]
        values = sample(gray, places[:, 0] / places[:, 2], places[:, 1] / places[:, 2])[:, 0]
        counts = weights * (values > 0)  # 0 where they fall beside the image
        self._sums[0, ids] += counts * values
        self._sums[1, ids] += counts

    def of_views(self) -> np.ndarray:
        """float32 [V], the weighted mean of what frames had; where there was none, `gray`."""
        total, counts = self._sums
        return np.where(counts > 0, total / np.maximum(counts, 1e-20), self.gray).astype(np.float32)


def register(view: ColorView, places: np.ndarray, gray: np.ndarray, start: np.ndarray) -> np.ndarray:
    """The warp of an image by which it agrees best with gray values of surface points.

    Gauss-Newton on an affine motion in the image, a gain and an offset of its gray values, with Cauchy's weights, from
    coarse to fine. (Zhou and Koltun 2014 move images by a lattice, against a mean of all as well; an affine motion has
    what late color, a rolling shutter and a wrong place of the camera do.)

    Args:
        view: the frame.
        places: float32 [N, 3], of `ColorView.homogeneous`, of points in front of the camera that it sees.
        gray: float32 [N], their gray values, 0 to 255.
        start: float64 [3, 3], the warp to begin with.

    Returns:
        float64 [3, 3], from (u, v, 1) by the pose to (u, v, 1) in the color image; `start` where there are too few
        points, or no plausible motion makes them agree better. Deterministic.
    """
    step = max(len(places) // _MOST_POINTS, 1)
    if len(places) < _LEAST_POINTS or np.subtract(*np.quantile(gray, (0.95, 0.05))) < _LEAST_SPREAD:
        return start
    u, v = (places[::step, axis] / places[::step, 2] for axis in (0, 1))
    normalize = _normalization(view.camera)
    basis = np.stack([np.ones_like(u), u * normalize[0, 0] + normalize[0, 2], v * normalize[1, 1] + normalize[1, 2]], 1)
    points = _Points(u, v, basis.astype(np.float64), gray[::step].astype(np.float64))
    first = motion = _motion(start, normalize)
    image = cv2.cvtColor(view.frame.color, cv2.COLOR_RGB2GRAY).astype(np.float32)
    for sigma in _SIGMAS_PX:
        layers = _with_slopes(cv2.GaussianBlur(image, (0, 0), sigma))
        for _ in range(_STEPS):
            motion = motion + _step(layers, points, motion)[0]
    if np.abs(motion).sum(1).max() > _MOST_PX or _step(layers, points, motion)[1] >= _step(layers, points, first)[1]:
        return start
    warp = np.eye(3)
    warp[:2] += motion[:, [1, 2, 0]] @ normalize
    return warp


def _normalization(camera: Camera) -> np.ndarray:
    """float64 [3, 3], from (u, v, 1) to coordinates from -1 to 1 over the larger side of the image, and 1."""
    half = 0.5 * max(camera.width, camera.height)
    return np.array([[1 / half, 0, -camera.cx / half], [0, 1 / half, -camera.cy / half], [0, 0, 1]])


def _motion(warp: np.ndarray, normalize: np.ndarray) -> np.ndarray:
    """Motion float64 [2, 3] (px) of a warp: shift, and stretches along u and v over half an image."""
    return ((warp - np.eye(3))[:2] @ np.linalg.inv(normalize))[:, [2, 0, 1]]


def _with_slopes(gray: np.ndarray) -> np.ndarray:
    """float32 [H, W, 3]: an image and its slopes along u and v, per px."""
    slopes = (cv2.Sobel(gray, cv2.CV_32F, *order, ksize=3, scale=0.125) for order in ((1, 0), (0, 1)))
    return cv2.merge([gray, *slopes])


def _step(layers: np.ndarray, points: _Points, motion: np.ndarray) -> tuple[np.ndarray, float]:
    """A Gauss-Newton step of the motion [2, 3], and the mean robust error before it."""
    shift = (points.basis @ motion.T).astype(np.float32)
    u, v = points.u + shift[:, 0], points.v + shift[:, 1]
    height, width = layers.shape[:2]
    inside = np.flatnonzero((u >= 0) & (v >= 0) & (u <= width - 1) & (v <= height - 1))
    if len(inside) < _LEAST_POINTS:
        return np.zeros((2, 3)), float("inf")
    value, slope_u, slope_v = sample(layers, u[inside], v[inside]).T.astype(np.float64)
    basis, wanted = points.basis[inside], points.gray[inside]
    gain, offset = _brightness(value, wanted)
    off = gain * value + offset - wanted
    weights = 1 / (1 + (off / _SCALE) ** 2)
    slopes = gain * slope_u[:, None] * basis, gain * slope_v[:, None] * basis
    rows = np.concatenate([*slopes, value[:, None], np.ones((len(value), 1))], axis=1)
    prior = np.r_[np.full(6, _PRIOR_POINTS * (_PRIOR_SLOPE / _PRIOR_PX) ** 2), 1e-6, 1e-6]
    matrix = (rows * weights[:, None]).T @ rows + np.diag(prior)
    right = -(rows.T @ (weights * off)) - prior * np.r_[motion.ravel(), 0, 0]
    return np.linalg.solve(matrix, right)[:6].reshape(2, 3), float(np.log1p((off / _SCALE) ** 2).mean())


def _brightness(value: np.ndarray, wanted: np.ndarray) -> tuple[float, float]:
    """Gain and offset that bring the middle and the spread of gray values to those wanted."""
    low, middle, high = np.quantile(value, (0.2, 0.5, 0.8))
    wanted_low, wanted_middle, wanted_high = np.quantile(wanted, (0.2, 0.5, 0.8))
    gain = float(np.clip((wanted_high - wanted_low) / max(high - low, 1.0), 0.5, 2.0))
    return gain, float(wanted_middle - gain * middle)
