"""Edges in depth images: the steps between pixels of one surface, and the frames that a recording is judged by."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from spslam.datasets.prefetch import Readable, prefetch
from spslam.errors import DatasetError
from spslam.meshing.reading import reading_threads

# Inverse depth of one surface differs by less than this share of it and so many deviations of the noise, as in
# `ops.measure_planes`; at an edge it differs by so many times as much.
_SAME_SHARE, _SAME_DEVIATIONS, EDGE = 0.015, 4.0, 4.0
# Frames that are looked at to judge a recording, and edges that they must have.
_FRAMES, LEAST_EDGES = 8, 100
_NEAREST_M = 1e-3


def summed_counts(depths: Readable[np.ndarray], count: Callable[[np.ndarray], np.ndarray]) -> np.ndarray:
    """What is counted in a few depth images spread over a recording, without those that can't be read.

    Args:
        depths: float32 [H, W] each, of one sensor.
        count: integers [N] of a depth image float32 [H, W], m; called on threads.

    Returns:
        int64 [N], the sums; [0] without any frame.
    """
    positions = np.unique(np.linspace(0, len(depths) - 1, _FRAMES).round().astype(int))[: len(depths)]
    with prefetch(_Counts(depths, positions, count), *reading_threads()) as counts:
        return sum((each for each in counts if not isinstance(each, DatasetError)), start=np.zeros(1, np.int64))


@dataclass(frozen=True)
class _Counts:
    """What is counted in each of some images, worked out on the threads that read."""

    depths: Readable[np.ndarray]
    positions: np.ndarray
    count: Callable[[np.ndarray], np.ndarray]

    def __len__(self) -> int:
        return len(self.positions)

    def __getitem__(self, index: int) -> np.ndarray:
        return self.count(self.depths[int(self.positions[index])])


def surface_steps(depth: np.ndarray, noise: tuple[float, float]) -> tuple[np.ndarray, np.ndarray]:
    """Inverse depth, and what that of two neighboring pixels of one surface differs by at most.

    Args:
        depth: float32 [H, W], m, 0 where unknown.
        noise: floor (m^2) and growth (1/m^2) of the variance of depth, as of `ops.measure_planes`.

    Returns:
        Two float32 [H, W], 1/m. Inverse depth is NaN where unknown.
    """
    known = np.isfinite(depth) & (depth > _NEAREST_M)
    safe = np.where(known, depth, np.float32(1))
    inverse = np.where(known, 1 / safe, np.float32(np.nan))
    deviation = np.sqrt(np.float32(noise[0]) + np.float32(noise[1]) * safe**4)
    return inverse, (np.float32(_SAME_SHARE) + np.float32(_SAME_DEVIATIONS) * deviation / safe) * inverse
