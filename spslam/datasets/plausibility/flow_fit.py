"""Motion between two views from points with depth in the first and their pixels in the second.

A pixel with depth is a point; the camera's motion carries it into the other view, where it must meet the pixel to which
optical flow followed it. Motion is free, so depth of another scale fits as well; a wrong focal length, a shifted
center, distortion or depth of another pixel does not.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from spslam.datasets.plausibility import lens as numbers_of
from spslam.datasets.plausibility.lens import Lens
from spslam.pose_graph import rotation_matrices

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
    return fit_flows([points], lens, free)[0]


def fit_flows(points: Sequence[Points], lens: Lens, free: Sequence[int] = ()) -> list[FlowFit]:
    """`fit_flow` of several pairs of views, all at once: each has few points.

    Args:
        points: of each pair.
        lens, free: as of `fit_flow`, of each pair by itself.
    """
    batch, chosen = _Batch.of(points), list(free)
    count = len(points)
    rotation, translation = np.tile(np.eye(3), (count, 1, 1)), np.zeros((count, 3))
    numbers = np.tile(lens.numbers, (count, 1))
    prior = np.concatenate((np.zeros(6), 1 / PRIOR[chosen] ** 2))
    for _ in range(_ITERATIONS if count else 0):
        residual, jacobian = batch.linearized(lens.with_numbers(numbers), rotation, translation, chosen)
        distance = np.linalg.norm(residual, axis=-1)
        sigma = np.maximum(1.4826 * batch.medians(distance), _LEAST_SIGMA_PX)[:, None]
        weight = batch.known / (1 + (distance / sigma) ** 2) ** 2 / sigma**2
        transposed = (jacobian * weight[..., None, None]).reshape(count, -1, len(prior)).swapaxes(1, 2)
        hessian = transposed @ jacobian.reshape(count, -1, len(prior))
        gradient = transposed @ residual.reshape(count, -1, 1)
        gradient[:, 6:, 0] += prior[6:] * numbers[:, chosen]
        step = -np.linalg.solve(hessian + _diagonal(prior + 1e-9 * (1 + _diagonals(hessian))), gradient)[..., 0]
        rotation = rotation_matrices(step[:, :3]) @ rotation
        translation = translation + step[:, 3:6]
        numbers[:, chosen] += np.clip(step[:, 6:], -_MOST_CHANGE, _MOST_CHANGE)
    information = np.zeros((count, numbers_of.COUNT, numbers_of.COUNT))
    if chosen and count:
        motion = hessian[:, :6, :6]
        motion = motion + _diagonal(1e-9 * (1 + _diagonals(motion)))
        coupling = hessian[:, :6, 6:]
        marginal = hessian[:, 6:, 6:] - coupling.swapaxes(1, 2) @ np.linalg.solve(motion, coupling)
        rows, columns = np.ix_(chosen, chosen)
        information[:, rows, columns] = (marginal + marginal.swapaxes(1, 2)) / 2
    final = batch.residuals(lens.with_numbers(numbers), rotation, translation)
    errors = batch.medians(np.linalg.norm(final, axis=-1)).tolist()
    return [FlowFit(*fit) for fit in zip(rotation, translation, errors, numbers, information, strict=True)]


@dataclass(frozen=True)
class _Batch:
    """Points of K pairs of views, as many of each as the longest has.

    Attributes:
        pixels_first, pixels_last: float64 [K, N, 2].
        depth: float64 [K, N], m; what is none of a pair's points lies in the image's corner at 1 m.
        known: bool [K, N], which are points.
    """

    pixels_first: np.ndarray
    depth: np.ndarray
    pixels_last: np.ndarray
    known: np.ndarray

    @classmethod
    def of(cls, points: Sequence[Points]) -> _Batch:
        """Of the points of each pair."""
        shape = len(points), max((len(each.depth) for each in points), default=0)
        first, last, depth = np.zeros((*shape, 2)), np.zeros((*shape, 2)), np.ones(shape)
        known = np.zeros(shape, bool)
        for row, each in enumerate(points):
            own = row, slice(len(each.depth))
            first[own], depth[own], last[own], known[own] = each.pixels_first, each.depth, each.pixels_last, True
        return cls(first, depth, last, known)

    def medians(self, values: np.ndarray) -> np.ndarray:
        """Median of each pair's values [K, N]."""
        ordered = np.sort(np.where(self.known, values, np.inf), axis=1)
        count = self.known.sum(axis=1)
        row = np.arange(len(ordered))
        return (ordered[row, (count - 1) // 2] + ordered[row, count // 2]) / 2

    def residuals(self, lens: Lens, rotation: np.ndarray, translation: np.ndarray) -> np.ndarray:
        """Pixel errors [K, N, 2] of K lenses, rotations [K, 3, 3] and translations [K, 3]."""
        moved = lens.points(self.pixels_first, self.depth) @ rotation.swapaxes(1, 2) + translation[:, None]
        return lens.pixels(moved) - self.pixels_last

    def linearized(
        self, lens: Lens, rotation: np.ndarray, translation: np.ndarray, chosen: Sequence[int]
    ) -> tuple[np.ndarray, np.ndarray]:
        """Pixel errors, and their derivatives [K, N, 2, 6 + C] by a turn, a shift and C chosen numbers of the lens.

        Those by numbers are differences.
        """
        turned = lens.points(self.pixels_first, self.depth) @ rotation.swapaxes(1, 2)
        pixels, by_point = lens.pixels_and_derivatives(turned + translation[:, None])
        residual = pixels - self.pixels_last
        derivatives = [np.cross(turned[:, :, None], by_point), by_point]
        for number in chosen:
            changed = lens.with_numbers(lens.numbers + _STEP * np.eye(numbers_of.COUNT)[number])
            derivatives.append((self.residuals(changed, rotation, translation) - residual)[..., None] / _STEP)
        return residual, np.concatenate(derivatives, axis=-1)


def _diagonals(matrices: np.ndarray) -> np.ndarray:
    """Diagonals [K, P] of matrices [K, P, P]."""
    return np.diagonal(matrices, axis1=1, axis2=2)


def _diagonal(values: np.ndarray) -> np.ndarray:
    """Diagonal matrices [K, P, P] of values [K, P]."""
    return values[..., None] * np.eye(values.shape[-1])
