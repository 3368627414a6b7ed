"""Do two depth images show the same surface? Depth alone decides, without color.

Works on inverse depth, which is linear along a plane's pixels (so interpolation is exact there), and whose error does
not grow with distance for triangulating sensors.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from spslam.datasets.plausibility.lens import Lens

_ITERATIONS = 8
_PIXEL_STEP = 6
_WINDOW_PX = 5
# Inverse depth may vary by this share within the window; at more there is an edge.
_FLAT = 0.10
_LEAST_POINTS = 150
_KERNEL = 1.5
_LEAST_SIGMA = 1e-5


@dataclass(frozen=True)
class Surface:
    """A depth image, corrected by a lens, as inverse depth.

    Attributes:
        inverse: float32 [h, w], 1/m, smoothed.
        slope_u: float32 [h, w], its derivative per pixel.
        slope_v: float32 [h, w].
        smooth: bool [h, w], where the surface is continuous.
    """

    inverse: np.ndarray
    slope_u: np.ndarray
    slope_v: np.ndarray
    smooth: np.ndarray

    @classmethod
    def of(cls, depth: np.ndarray, lens: Lens) -> Surface:
        """The surface in a depth image [h, w]."""
        corrected = _corrected(depth, lens)
        known = corrected > 0
        inverse = np.zeros_like(corrected)
        np.divide(1, corrected, out=inverse, where=known)
        kernel = np.ones((_WINDOW_PX, _WINDOW_PX), np.uint8)
        low, high = cv2.erode(inverse, kernel), cv2.dilate(inverse, kernel)
        mean = cv2.blur(inverse, (_WINDOW_PX, _WINDOW_PX))
        slope_u, slope_v = (cv2.Sobel(mean, cv2.CV_32F, *order, ksize=3) / 8 for order in ((1, 0), (0, 1)))
        return cls(mean, slope_u, slope_v, (low > 0) & (high < (1 + _FLAT) * low))


@dataclass(frozen=True)
class SurfaceFit:
    """How one surface lies on another.

    Attributes:
        motion: float64 [4, 4], T_last_first.
        error: robust standard deviation of inverse depth, 1/m of the depth as given.
        points: how many points overlap.
    """

    motion: np.ndarray
    error: float
    points: int


def fit_surfaces(first: Surface, last: Surface, lens: Lens, motion: np.ndarray) -> SurfaceFit | None:
    """Robust Gauss-Newton over the motion.

    Args:
        first: surface of the first view.
        last: surface of the last view.
        lens: of both.
        motion: float64 [4, 4] T_last_first to begin with.

    Returns:
        None where too little overlaps.
    """
    pixels, inverse = _samples(first)
    lens = _without_depth_correction(lens)
    points = lens.points(pixels, 1 / inverse)
    rotation, translation = motion[:3, :3].copy(), motion[:3, 3].copy()
    for _ in range(_ITERATIONS):
        terms = _terms(points, rotation, translation, last, lens)
        if terms is None:
            return None
        residual, columns = terms
        sigma = max(1.4826 * float(np.median(np.abs(residual))), _LEAST_SIGMA)
        weighted = columns * (1 / (1 + (residual / (_KERNEL * sigma)) ** 2) ** 2 / sigma**2)[:, None]
        hessian = weighted.T @ columns
        step = -np.linalg.solve(hessian + 1e-9 * np.diag(1 + np.diag(hessian)), weighted.T @ residual)
        rotation = cv2.Rodrigues(step[:3])[0] @ rotation
        translation = translation + step[3:]
    fitted = np.eye(4)
    fitted[:3, :3], fitted[:3, 3] = rotation, translation
    return SurfaceFit(fitted, sigma, len(residual))


def _corrected(depth: np.ndarray, lens: Lens) -> np.ndarray:
    """Depth with the lens's correction of depth, float32 [h, w]."""
    if not lens.numbers[[-2, -1]].any():
        return depth
    height, width = depth.shape
    v, u = np.mgrid[:height, :width]
    points = lens.points(np.column_stack((u.ravel(), v.ravel())).astype(np.float64), depth.ravel().astype(np.float64))
    corrected = points[:, 2].reshape(height, width).astype(np.float32)
    return np.where((depth > 0) & (corrected > 0), corrected, 0).astype(np.float32)


def _without_depth_correction(lens: Lens) -> Lens:
    """The lens without corrections of depth: those are in the surfaces already."""
    numbers = lens.numbers.copy()
    numbers[[-2, -1]] = 0
    return lens.with_numbers(numbers)


def _samples(surface: Surface) -> tuple[np.ndarray, np.ndarray]:
    height, width = surface.inverse.shape
    v, u = np.mgrid[_PIXEL_STEP // 2 : height : _PIXEL_STEP, _PIXEL_STEP // 2 : width : _PIXEL_STEP]
    smooth = surface.smooth[v, u]
    u, v = u[smooth], v[smooth]
    return np.column_stack((u, v)).astype(np.float64), surface.inverse[v, u].astype(np.float64)


def _terms(
    points: np.ndarray, rotation: np.ndarray, translation: np.ndarray, last: Surface, lens: Lens
) -> tuple[np.ndarray, np.ndarray] | None:
    """Residuals [N] and their derivatives by rotation and translation [N, 6]."""
    turned = points @ rotation.T
    moved = turned + translation
    height, width = last.inverse.shape
    pixels = lens.pixels(moved)
    u, v = np.rint(np.clip(np.nan_to_num(pixels), -1, max(width, height))).astype(int).T
    seen = (moved[:, 2] > 0) & (u >= 1) & (u < width - 1) & (v >= 1) & (v < height - 1)
    u, v = np.where(seen, u, 0), np.where(seen, v, 0)
    seen &= last.smooth[v, u]
    if np.count_nonzero(seen) < _LEAST_POINTS:
        return None
    turned, moved, pixels, u, v = turned[seen], moved[seen], pixels[seen], u[seen], v[seen]
    slope_u, slope_v = last.slope_u[v, u].astype(np.float64), last.slope_v[v, u].astype(np.float64)
    measured = last.inverse[v, u] + slope_u * (pixels[:, 0] - u) + slope_v * (pixels[:, 1] - v)
    depth = moved[:, 2]
    residual = 1 / depth - measured
    along_u, along_v = slope_u * lens.focal[0] / depth, slope_v * lens.focal[1] / depth
    by_z = -1 / depth**2 + (along_u * moved[:, 0] + along_v * moved[:, 1]) / depth
    by_point = np.column_stack((-along_u, -along_v, by_z))
    return residual, np.column_stack((np.cross(turned, by_point), by_point))
