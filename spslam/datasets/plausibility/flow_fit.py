"""Motion between two views from points with depth in the first and their pixels in the second.

A pixel with depth is a point; the camera's motion carries it into the other view, where it must meet the pixel to which
optical flow followed it. Motion is free, so depth of another scale fits as well; a wrong focal length, a shifted
center, distortion or depth of another pixel does not.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from spslam.datasets.plausibility import lens as numbers_of
from spslam.datasets.plausibility.lens import Lens

_ITERATIONS = 12
# Tracks are no better than this, or a perfect rendering would make one point decide.
_LEAST_SIGMA_PX = 0.05
_STEP = 1e-5
_MOST_CHANGE = 0.15
# What a number is likely to be off by where the views say nothing about it.
PRIOR = np.array([0.5, 0.1, 0.1, 0.1, 0.3, 0.5, 0.5])
# Depth is taken where it varies by less than this share within two pixels: an edge's point may lie on either side.
_FLAT = 0.08


@dataclass(frozen=True)
class Points:
    """Points that two views share.

    Attributes:
        pixels_first: float64 [N, 2].
        depth: float64 [N], m, in the first view.
        pixels_last: float64 [N, 2].
    """

    pixels_first: np.ndarray
    depth: np.ndarray
    pixels_last: np.ndarray


@dataclass(frozen=True)
class FlowFit:
    """A motion that carries points to their pixels.

    Attributes:
        rotation: float64 [3, 3], of camera points of the first view into the last.
        translation: float64 [3], m.
        error_px: median distance to the pixels.
        numbers: float64 [7] of `Lens`.
        information: float64 [7, 7], the inverse covariance of those numbers that were free (motion marginalized), 0 for
            others.
    """

    rotation: np.ndarray
    translation: np.ndarray
    error_px: float
    numbers: np.ndarray
    information: np.ndarray

    @property
    def motion(self) -> np.ndarray:
        """float64 [4, 4], T_last_first."""
        motion = np.eye(4)
        motion[:3, :3], motion[:3, 3] = self.rotation, self.translation
        return motion


def depth_at(depth: np.ndarray, pixels: np.ndarray) -> np.ndarray:
    """Depth [N] at pixels [N, 2] (u, v): the median of nine around, 0 at edges, holes and outside the image."""
    height, width = depth.shape
    u, v = np.rint(pixels).astype(int).T
    inside = (u >= 2) & (u < width - 2) & (v >= 2) & (v < height - 2)
    u, v = np.where(inside, u, 2), np.where(inside, v, 2)
    if height < 5 or width < 5:
        return np.zeros(len(pixels))
    around = np.stack([depth[v + dv, u + du] for dv in (-2, 0, 2) for du in (-2, 0, 2)])
    low, high = around.min(axis=0), around.max(axis=0)
    flat = inside & (low > 0) & (high < (1 + _FLAT) * low)
    return np.where(flat, np.median(around, axis=0), 0).astype(np.float64)


def fit_flow(points: Points, lens: Lens, free: Sequence[int] = ()) -> FlowFit:
    """Robust Gauss-Newton over the motion and some numbers of the lens.

    Args:
        points: six or more.
        lens: to begin with.
        free: which of its numbers may change.
    """
    rotation, translation, numbers = np.eye(3), np.zeros(3), lens.numbers.copy()
    chosen = list(free)
    prior = np.concatenate((np.zeros(6), 1 / PRIOR[chosen] ** 2))
    for _ in range(_ITERATIONS):
        residual, *changed = _residuals(points, lens, *_variations(rotation, translation, numbers, chosen))
        jacobian = (np.stack(changed, axis=-1) - residual[..., None]) / _STEP
        distance = np.linalg.norm(residual, axis=1)
        sigma = max(1.4826 * float(np.median(distance)), _LEAST_SIGMA_PX)
        weight = 1 / (1 + (distance / sigma) ** 2) ** 2 / sigma**2
        weighted = jacobian * weight[:, None, None]
        hessian = np.einsum("nij,nik->jk", weighted, jacobian)
        gradient = np.einsum("nij,ni->j", weighted, residual)
        damped = hessian + np.diag(prior + 1e-9 * (1 + np.diag(hessian)))
        gradient[6:] += prior[6:] * numbers[chosen]
        step = -np.linalg.solve(damped, gradient)
        rotation = cv2.Rodrigues(step[:3])[0] @ rotation
        translation = translation + step[3:6]
        numbers[chosen] += np.clip(step[6:], -_MOST_CHANGE, _MOST_CHANGE)
    information = np.zeros((numbers_of.COUNT, numbers_of.COUNT))
    if chosen:
        motion = hessian[:6, :6] + 1e-9 * np.diag(1 + np.diag(hessian[:6, :6]))
        marginal = hessian[6:, 6:] - hessian[6:, :6] @ np.linalg.solve(motion, hessian[:6, 6:])
        information[np.ix_(chosen, chosen)] = (marginal + marginal.T) / 2
    final = _residuals(points, lens, rotation[None], translation[None], numbers[None])[0]
    error = float(np.median(np.linalg.norm(final, axis=1)))
    return FlowFit(rotation, translation, error, numbers, information)


_SHIFTS = _STEP * np.eye(3)
_TURNS = np.stack([cv2.Rodrigues(turn)[0] for turn in _SHIFTS])


def _variations(
    rotation: np.ndarray, translation: np.ndarray, numbers: np.ndarray, chosen: Sequence[int]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Motion and numbers as they are, then with each free parameter changed by a step: [K, 3, 3], [K, 3], [K, 7]."""
    count = 7 + len(chosen)
    rotations, translations = np.tile(rotation, (count, 1, 1)), np.tile(translation, (count, 1))
    all_numbers = np.tile(numbers, (count, 1))
    rotations[1:4] = _TURNS @ rotation
    translations[4:7] += _SHIFTS
    all_numbers[np.arange(7, count), chosen] += _STEP
    return rotations, translations, all_numbers


def _residuals(
    points: Points, lens: Lens, rotations: np.ndarray, translations: np.ndarray, numbers: np.ndarray
) -> np.ndarray:
    """Pixel errors of K motions with as many numbers, float64 [K, N, 2]: all in one go, as N is small."""
    lenses = lens.with_numbers(numbers)
    moved = lenses.points(points.pixels_first, points.depth) @ rotations.transpose(0, 2, 1) + translations[:, None]
    return lenses.pixels(moved) - points.pixels_last
