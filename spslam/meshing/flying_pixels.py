"""Flying pixels: those that mix a near and a far surface, and measure a point between them, where there is nothing.

A time-of-flight camera has one or two across every edge. A single frame's plane fit takes them for a steep surface, and
as long as the camera looks from one side all frames agree on it: a veil from the edge to what lies behind.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from spslam.datasets.prefetch import Readable
from spslam.meshing.depth_edges import EDGE, LEAST_EDGES, summed_counts, surface_steps

# Before and after a pixel: the nearest ones that may lie on the two surfaces, px. Two pixels side by side may be mixed.
_SIDES = ((-1, 1), (-1, 2), (-2, 1))
_MARGIN = 3
# Beyond these a surface goes on: the next step is at most this share of the change across the edge.
_FLAT = 0.25
# Edges that are crossed by flying pixels, as a share of these and of sharp ones: 0.89 to 0.99 with time of flight, at
# most 0.72 with others, in a stairwell, whose treads are narrow surfaces.
_FLYING_SHARE = 0.8


def has_flying_pixels(depths: Readable[np.ndarray], noise: tuple[float, float]) -> bool:
    """Whether the edges of a recording are of flying pixels, judged by a few images spread over it.

    Args:
        depths: float32 [H, W] each, m, 0 where unknown, of one sensor; those that can't be read don't count.
        noise: as of `flying_pixels`.
    """

    def count(depth: np.ndarray) -> np.ndarray:
        counts = np.zeros(2, np.int64)
        for steps in _both_ways(depth, noise):
            counts += _crossings(*steps, 0), sum(_crossings(*steps, width) for width in (1, 2))
        return counts

    sharp, flying = np.broadcast_to(summed_counts(depths, count), 2)
    return bool(flying + sharp >= LEAST_EDGES and flying > _FLYING_SHARE * (flying + sharp))


def flying_pixels(depth: np.ndarray, noise: tuple[float, float]) -> np.ndarray:
    """Pixels that lie between a nearer and a farther surface beside them, and are on neither.

    A surface that is one or two pixels wide there looks the same; see `has_flying_pixels`.

    Args:
        depth: float32 [H, W], m, 0 where unknown.
        noise: floor (m^2) and growth (1/m^2) of the variance of depth, as of `ops.measure_planes`.

    Returns:
        Bool [H, W]; an empty image gives an empty one. Deterministic.
    """
    rows, columns = _both_ways(depth, noise)
    return _along_rows(*rows) | _along_rows(*columns).T


def _both_ways(depth: np.ndarray, noise: tuple[float, float]) -> tuple[tuple[np.ndarray, np.ndarray], ...]:
    """Inverse depth and gate as they are, and with rows and columns exchanged."""
    inverse, gate = surface_steps(depth, noise)
    return (inverse, gate), (np.ascontiguousarray(inverse.T), np.ascontiguousarray(gate.T))


def _along_rows(inverse: np.ndarray, gate: np.ndarray) -> np.ndarray:
    """Bool [H, W]: those between the pixels on their left and on their right."""
    found = np.zeros(inverse.shape, bool)
    for before, after in _SIDES:
        edges = _Edges.between(inverse, gate, before, after)
        found[edges.rows, edges.columns] |= edges.are_around(inverse, gate, 0)
    return found


def _crossings(inverse: np.ndarray, gate: np.ndarray, width: int) -> int:
    """How many edges along rows have so many pixels, all on neither surface, between the two."""
    edges = _Edges.between(inverse, gate, -1, width)
    crossed = np.ones(len(edges.rows), bool)
    for step in range(width):
        crossed &= edges.are_around(inverse, gate, step)
    return int(crossed.sum())


@dataclass(frozen=True)
class _Edges:
    """Pixels around which one flat surface ends and another begins.

    Attributes:
        rows, columns: int64 [N].
        one, other: float32 [N], inverse depth of the last pixel of the one and of the first of the other, 1/m.
    """

    rows: np.ndarray
    columns: np.ndarray
    one: np.ndarray
    other: np.ndarray

    @staticmethod
    def between(inverse: np.ndarray, gate: np.ndarray, before: int, after: int) -> _Edges:
        """Those whose surfaces end and begin so many pixels to the right. Comparisons with what is unknown are False.

        What is unknown beyond is taken for flat: surfaces end there too.
        """
        width = inverse.shape[1]
        padded = np.pad(inverse, ((0, 0), (_MARGIN, _MARGIN)), constant_values=np.nan)
        left, right = (padded[:, _MARGIN + step : _MARGIN + step + width] for step in (before, after))
        rows, columns = np.nonzero(np.abs(right - left) > EDGE * gate)
        at = columns + _MARGIN
        one, other = (padded[rows, at + step] for step in (before, after))
        most = _FLAT * np.abs(other - one)
        rising = np.abs(padded[rows, at + before - 1] - one) > most
        rising |= np.abs(padded[rows, at + after + 1] - other) > most
        flat = ~rising
        return _Edges(rows[flat], columns[flat], one[flat], other[flat])

    def are_around(self, inverse: np.ndarray, gate: np.ndarray, step: int) -> np.ndarray:
        """Bool [N]: whether the pixel so many steps to the right is on neither surface and between the two."""
        middle, most = (image[self.rows, self.columns + step] for image in (inverse, gate))
        apart = np.minimum(np.abs(middle - self.one), np.abs(middle - self.other)) > most
        return apart & ((middle - self.one) * (self.other - middle) > 0)
