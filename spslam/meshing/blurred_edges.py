"""Depth that was smoothed over edges, as a phone's LiDAR's is: whether a recording has it, and what pixels it spoils.

Between a near and a far surface such depth has a ramp of several pixels, where there is nothing. A single frame's plane
fit takes it for a steep surface, and all frames agree on it as long as the camera looks from one side. Other sensors
pass an edge within two pixels.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np

from spslam.datasets.prefetch import Readable
from spslam.meshing.depth_edges import EDGE, LEAST_EDGES, summed_counts, surface_steps

# Half the width of the ramps that are looked for, and how far beyond it depth must be flat again, px.
_REACH, _BEYOND = 3, 2
# Beyond an edge the slope is at most this share of the mean slope across it.
_FLAT = 0.5
# Two neighboring steps, with one mixed pixel between them, have this share of a sharp edge.
_SHARP = 0.8
# The inner pixels, two to each side of the middle, have this share of the change across a ramp; of the tread of a stair
# it is two thirds.
_INNER, _INNER_SHARE = 2, 0.8
# The share of edges that is blurred: at most 0.6 where a sensor mixes single pixels (time of flight), 1 where it
# smooths.
_BLURRED_SHARE = 0.8


def edges_are_blurred(depths: Readable[np.ndarray], noise: tuple[float, float]) -> bool:
    """Whether the depth of a recording is smoothed over edges, judged by a few images spread over it.

    Args:
        depths: float32 [H, W] each, m, 0 where unknown, of one sensor; those that can't be read don't count.
        noise: floor (m^2) and growth (1/m^2) of the variance of depth, as of `ops.measure_planes`.
    """

    def count(depth: np.ndarray) -> np.ndarray:
        counts = np.zeros(2, np.int64)
        for profile in _whole_profiles(depth, noise):
            found = profile.middles() & profile.whole()
            counts += found.sum(), (found & ~profile.sharp()).sum()
        return counts

    edges, blurred = np.broadcast_to(summed_counts(depths, count), 2)
    return bool(edges >= LEAST_EDGES and blurred > _BLURRED_SHARE * edges)


def without_blurred_edges(depth: np.ndarray, noise: tuple[float, float]) -> np.ndarray:
    """Depth without the pixels that lie between two surfaces, and those beside them.

    Args:
        depth: float32 [H, W], m, 0 where unknown.
        noise: as of `edges_are_blurred`.

    Returns:
        float32 [H, W], 0 there; an empty image as it is. Deterministic.
    """
    if not depth.size:
        return depth
    spoiled = np.zeros(depth.shape, np.uint8)
    for profile, along in zip(_profiles(depth, noise), ((1, 2 * _REACH + 1), (2 * _REACH + 1, 1)), strict=True):
        middles = (profile.middles() & profile.narrow()).astype(np.uint8)
        spoiled |= cv2.dilate(middles, np.ones(along, np.uint8)) & profile.between().astype(np.uint8)
    return np.where(cv2.dilate(spoiled, np.ones((3, 3), np.uint8)), np.float32(0), depth)


@dataclass(frozen=True)
class _Profiles:
    """Inverse depth along the rows, or the columns, around pixels. Comparisons with what is unknown are False.

    Attributes:
        around: float32 [2 (_REACH + _BEYOND) + 1, ...], NaN where unknown; the middle one is the pixel.
        gate: float32 [...], what two pixels of one surface differ by at most.
    """

    around: np.ndarray
    gate: np.ndarray

    def middles(self) -> np.ndarray:
        """Bool [...]: pixels in the middle of an edge between two flat surfaces."""
        steps = np.nan_to_num(np.abs(np.diff(self.around[_BEYOND:-_BEYOND], axis=0)))
        return self._edge() & (steps[_REACH - 1 : _REACH + 1].max(0) >= steps.max(0))

    def whole(self) -> np.ndarray:
        """Bool [...]: depth is known all around."""
        return np.isfinite(self.around).all(0)

    def narrow(self) -> np.ndarray:
        """Bool [...]: most of the change is near the middle."""
        before, after = self._within(_INNER)
        return np.abs(after - before) >= _INNER_SHARE * self._change

    def sharp(self) -> np.ndarray:
        """Bool [...]: two neighboring steps make nearly all of the change."""
        inner = self.around[_BEYOND:-_BEYOND]
        return np.abs(inner[2:] - inner[:-2]).max(0) >= _SHARP * self._change

    def between(self) -> np.ndarray:
        """Bool [...]: pixels at an edge that are on neither side."""
        before, after = self._sides
        middle = self.around[_REACH + _BEYOND]
        apart = np.minimum(np.abs(middle - before), np.abs(middle - after))
        return self._edge() & (apart > self.gate)

    def _edge(self) -> np.ndarray:
        """Whether there is one within reach, flat beyond. What is unknown is taken for flat: ramps end there too."""
        before, after = self._sides
        most = _FLAT * _BEYOND / (2 * _REACH) * self._change
        rising = (np.abs(self.around[0] - before) > most) | (np.abs(self.around[-1] - after) > most)
        return (self._change > EDGE * self.gate) & ~rising

    @cached_property
    def _change(self) -> np.ndarray:
        before, after = self._sides
        return np.abs(after - before)

    @cached_property
    def _sides(self) -> tuple[np.ndarray, np.ndarray]:
        return self._within(_REACH)

    def _within(self, reach: int) -> tuple[np.ndarray, np.ndarray]:
        """The farthest known pixels within reach before and after each one, or the pixel itself."""
        middle = _REACH + _BEYOND
        before = after = self.around[middle]
        for step in range(1, reach + 1):
            before = np.where(np.isnan(self.around[middle - step]), before, self.around[middle - step])
            after = np.where(np.isnan(self.around[middle + step]), after, self.around[middle + step])
        return before, after


def _profiles(depth: np.ndarray, noise: tuple[float, float]) -> tuple[_Profiles, _Profiles]:
    """Those along rows and along columns."""
    inverse, gate = surface_steps(depth, noise)
    margin = _REACH + _BEYOND
    height, width = depth.shape
    wide = np.pad(inverse, ((0, 0), (margin, margin)), constant_values=np.nan)
    high = np.pad(inverse, ((margin, margin), (0, 0)), constant_values=np.nan)
    steps = range(2 * margin + 1)
    rows = _Profiles(np.stack([wide[:, step : step + width] for step in steps]), gate)
    return rows, _Profiles(np.stack([high[step : step + height] for step in steps]), gate)


def _whole_profiles(depth: np.ndarray, noise: tuple[float, float]) -> tuple[_Profiles, _Profiles]:
    """Those around the N pixels that may be at an edge and have known depth all around, [11, N]; others may be among
    them. A tenth of the time of all."""
    inverse, gate = surface_steps(depth, noise)
    along_rows = _at_changes(inverse, gate)
    return along_rows, _at_changes(np.ascontiguousarray(inverse.T), np.ascontiguousarray(gate.T))


def _at_changes(inverse: np.ndarray, gate: np.ndarray) -> _Profiles:
    """Those along rows around pixels with another depth in reach before them than after."""
    margin = _REACH + _BEYOND
    if inverse.shape[1] <= 2 * margin:
        return _Profiles(np.zeros((2 * margin + 1, 0), np.float32), np.zeros(0, np.float32))
    change = inverse[:, margin + _REACH : -_BEYOND] - inverse[:, _BEYOND : -margin - _REACH]
    rows, columns = np.nonzero(np.abs(change) > EDGE * gate[:, margin:-margin])
    columns += margin
    around = np.stack([inverse[rows, columns + step] for step in range(-margin, margin + 1)])
    return _Profiles(around, gate[rows, columns])
