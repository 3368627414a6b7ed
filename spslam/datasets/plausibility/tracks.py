"""Points of the color images followed from view to view by optical flow.

Shi and Tomasi, *Good Features to Track*, CVPR 1994; Lucas and Kanade with pyramids (J.-Y. Bouguet, Intel, 2000), each
point also followed back, and kept if it returns.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import cv2
import numpy as np

from spslam.datasets.plausibility.views import View

_MOST_POINTS, _QUALITY, _DISTANCE_PX = 300, 0.01, 8
# A segment needs this many points, and this share of those that it began with: what is left must still cover the image.
_LEAST_POINTS, _KEPT_SHARE = 50, 0.35
_MOST_STEPS = 8
_RETURN_PX = 0.5
_WINDOW_PX, _LEVELS = 15, 3
_STOP = (cv2.TERM_CRITERIA_COUNT + cv2.TERM_CRITERIA_EPS, 15, 0.03)


@dataclass(frozen=True)
class Segment:
    """Points followed from one view to a later one.

    Attributes:
        first: number of the view in its stretch.
        last: number of the view in its stretch.
        pixels_first: float64 [N, 2] (u, v) in the first view.
        pixels_last: float64 [N, 2] (u, v) in the last one.
    """

    first: int
    last: int
    pixels_first: np.ndarray
    pixels_last: np.ndarray


@dataclass(frozen=True)
class Tracks:
    """What could be followed.

    Attributes:
        segments: one after another; each begins where the one before ends or was lost.
        steps: number of steps from a view with enough features to the next one.
        broken: how many of them no segment could take.
    """

    segments: list[Segment]
    steps: int
    broken: int


@dataclass(frozen=True)
class Followed:
    """What was followed in some views, so that it is not again where more views are added behind them.

    Attributes:
        points: of a view, by its number.
        steps: where the points that began in one view came to in another, and which returned; by both numbers.
    """

    points: dict[int, np.ndarray | None] = field(default_factory=dict)
    steps: dict[tuple[int, int], tuple[np.ndarray, np.ndarray]] = field(default_factory=dict)


def follow(views: Sequence[View], followed: Followed | None = None) -> Tracks:
    """Follows points through views; see `Tracks`. Deterministic.

    Args:
        views: in order.
        followed: of the same views without the last ones; brought up to date. Results are the same without it.
    """
    followed = followed or Followed()
    segments, steps, broken, first = [], 0, 0, 0
    while first + 1 < len(views):
        points = _points(views, first, followed)
        if points is None or len(points) < _LEAST_POINTS:
            first += 1
            continue
        segment = _longest(views, first, points, followed)
        if segment is None:
            steps, broken, first = steps + 1, broken + 1, first + 1
        else:
            segments.append(segment)
            steps, first = steps + segment.last - segment.first, segment.last
    return Tracks(segments, steps, broken)


def _points(views: Sequence[View], first: int, followed: Followed) -> np.ndarray | None:
    if first not in followed.points:
        found = cv2.goodFeaturesToTrack(views[first].gray, _MOST_POINTS, _QUALITY, _DISTANCE_PX)
        followed.points[first] = found
    return followed.points[first]


def _longest(views: Sequence[View], first: int, points: np.ndarray, followed: Followed) -> Segment | None:
    least = max(_LEAST_POINTS, _KEPT_SHARE * len(points))
    begin, here, segment = points, points, None
    for view in range(first, min(first + _MOST_STEPS, len(views) - 1)):
        if (first, view + 1) not in followed.steps:
            followed.steps[first, view + 1] = _step(views[view].gray, views[view + 1].gray, here)
        there, kept = followed.steps[first, view + 1]
        if np.count_nonzero(kept) < least:
            break
        begin, here = begin[kept], there[kept]
        segment = Segment(first, view + 1, begin[:, 0].astype(np.float64), here[:, 0].astype(np.float64))
    return segment


def _step(image: np.ndarray, following: np.ndarray, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    there, found = _flow(image, following, points)
    back, found_back = _flow(following, image, there)
    returned = np.abs(back - points).reshape(len(points), 2).max(axis=1) < _RETURN_PX
    return there, (found[:, 0] > 0) & (found_back[:, 0] > 0) & returned


def _flow(image: np.ndarray, following: np.ndarray, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    guess = points.copy()
    there, found, _ = cv2.calcOpticalFlowPyrLK(
        image, following, points, guess, winSize=(_WINDOW_PX, _WINDOW_PX), maxLevel=_LEVELS, criteria=_STOP
    )
    return np.asarray(there), np.asarray(found)
