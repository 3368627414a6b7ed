"""Points of the color images followed from view to view by optical flow.

Shi and Tomasi, *Good Features to Track*, CVPR 1994; Lucas and Kanade with pyramids (J.-Y. Bouguet, Intel, 2000), each
point also followed back, and kept if it returns. Where an image has next to no texture, its best corners are noise, or
stairs of pixels on an edge, along which flow goes anywhere and back: so a point must be located in every direction, by
more than the image's noise, whose deviation is taken from second differences (J. Immerkaer, *Fast Noise Variance
Estimation*, CVIU 1996).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import cv2
import numpy as np

from spslam.datasets.plausibility.views import View

_MOST_POINTS, _QUALITY, _DISTANCE_PX = 300, 0.01, 8
_MOST_LOCATED = 0.8  # robust fits bear the others, and see more of the image with them
# A segment needs this many points, and this share of those that it began with: what is left must still cover the image.
_LEAST_POINTS, _KEPT_SHARE = 50, 0.35
_MOST_STEPS = 8
_RETURN_PX = 0.5
_STANDING_PX, _MOVING_PX = 0.5, 3.0
_WINDOW_PX, _LEVELS = 15, 3
# By noise, a point is followed with a deviation of at most this in every direction; and edges, whose stairs of pixels
# stay where they are, are told from corners as by D. Lowe, *Distinctive Image Features*, IJCV 2004, section 4.1.
_DEVIATION_PX, _LEAST_RATIO = 0.2, 0.1
_SECOND_DIFFERENCES = np.outer([1, -2, 1], [1, -2, 1]).astype(np.float32)  # noise of deviation 1 becomes one of 6
_LEAST_NOISE = 0.3  # of a rounded image
_MEDIAN_TO_DEVIATION = 1.4826
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
        steps: number of steps from a view with enough features to the next one, of which most were followed or lost.
        broken: in how many of them most were lost.
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
        turns: of `lag_findings`: how the depth image of a view turned to the next one's, by its number.
    """

    points: dict[int, np.ndarray | None] = field(default_factory=dict)
    steps: dict[tuple[int, int], tuple[np.ndarray, np.ndarray]] = field(default_factory=dict)
    turns: dict[int, np.ndarray] = field(default_factory=dict)


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
        if segment is None:  # most points were lost, or there are few
            is_broken = np.mean(followed.steps[first, first + 1][1]) < _KEPT_SHARE
            steps, broken, first = steps + is_broken, broken + is_broken, first + 1
        else:
            segments.append(_without_standing(segment))
            steps, first = steps + segment.last - segment.first, segment.last
    return Tracks(segments, steps, broken)


def follow_once(views: Sequence[View], followed: Followed) -> list[tuple[np.ndarray, np.ndarray]]:
    """Points followed from each view to the next one: float64 [N, 2] (u, v) in both, N may be 0; as of `follow`."""
    pairs = []
    for first in range(len(views) - 1):
        points = _points(views, first, followed)
        if points is None or len(points) == 0:
            pairs.append((np.zeros((0, 2)), np.zeros((0, 2))))
            continue
        there, kept = _step(views, (first, first), points, followed)
        pairs.append((points[kept][:, 0].astype(np.float64), there[kept][:, 0].astype(np.float64)))
    return pairs


def _points(views: Sequence[View], first: int, followed: Followed) -> np.ndarray | None:
    if first not in followed.points:
        gray = views[first].gray
        found = cv2.goodFeaturesToTrack(gray, _MOST_POINTS, _QUALITY, _DISTANCE_PX)
        if found is not None:
            are_located = _are_located(gray, found)
            found = found if np.mean(are_located) > _MOST_LOCATED else found[are_located]
        followed.points[first] = found
    return followed.points[first]


def _are_located(gray: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Whether flow can follow points [N, 1, 2] in every direction: bool [N].

    Flow is the least-squares solution of gradients times displacement = difference of the images over the window, so
    its covariance is 2 s^2 inv(T), s being the noise and T the sum of the gradients' outer products, less the s^2 / 2
    that noise adds to each of their squares.
    """
    image = gray.astype(np.float32)
    noise = _MEDIAN_TO_DEVIATION * float(np.median(np.abs(cv2.filter2D(image, -1, _SECOND_DIFFERENCES)))) / 6
    variance, window = max(noise, _LEAST_NOISE) ** 2, (_WINDOW_PX, _WINDOW_PX)
    dx, dy = (cv2.Sobel(image, -1, *order, ksize=1, scale=0.5) for order in ((1, 0), (0, 1)))
    column, row = np.rint(points[:, 0]).astype(int).T
    xx, xy, yy = (
        cv2.boxFilter(product, -1, window, normalize=False)[row, column] for product in (dx * dx, dx * dy, dy * dy)
    )
    mean, half = (xx + yy) / 2 - _WINDOW_PX**2 * variance / 2, np.hypot((xx - yy) / 2, xy)
    return (mean - half > 2 * variance / _DEVIATION_PX**2) & (mean - half > _LEAST_RATIO * (mean + half))


def _longest(views: Sequence[View], first: int, points: np.ndarray, followed: Followed) -> Segment | None:
    least = max(_LEAST_POINTS, _KEPT_SHARE * len(points))
    begin, here, segment = points, points, None
    for view in range(first, min(first + _MOST_STEPS, len(views) - 1)):
        there, kept = _step(views, (first, view), here, followed)
        if np.count_nonzero(kept) < least:
            break
        begin, here = begin[kept], there[kept]
        segment = Segment(first, view + 1, begin[:, 0].astype(np.float64), here[:, 0].astype(np.float64))
    return segment


def _without_standing(segment: Segment) -> Segment:
    """A segment without the points that stand still in the image while most of it moves: text was drawn over it, or
    something moves along with the camera. What depth says of them is not what they show."""
    moved_px = np.linalg.norm(segment.pixels_last - segment.pixels_first, axis=1)
    stays = (moved_px > _STANDING_PX) | (np.median(moved_px) < _MOVING_PX)
    return replace(segment, pixels_first=segment.pixels_first[stays], pixels_last=segment.pixels_last[stays])


def _step(
    views: Sequence[View], numbers: tuple[int, int], here: np.ndarray, followed: Followed
) -> tuple[np.ndarray, np.ndarray]:
    """Where points that began in a view come to from another one to the next, and which return; by both numbers."""
    begin, view = numbers
    if (begin, view + 1) not in followed.steps:
        followed.steps[begin, view + 1] = _there_and_back(views[view].gray, views[view + 1].gray, here)
    return followed.steps[begin, view + 1]


def _there_and_back(image: np.ndarray, following: np.ndarray, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
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
