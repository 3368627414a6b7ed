"""Are the color and the depth image of a frame of one time? Both cameras turn together, so both say when.

How far the camera turns from view to view is found once by how points of color move and once by how depth images lie on
one another. Where one series of turns is the other one some time later, images are paired that are so far apart; as
gyroscopes are synchronized with cameras. What tracking measures by itself and takes account of is no finding.
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np

from spslam.datasets.findings import Finding
from spslam.datasets.plausibility.flow_fit import Points, depth_at, fit_flows
from spslam.datasets.plausibility.lens import Lens
from spslam.datasets.plausibility.surface_fit import Surface, fit_surfaces
from spslam.datasets.plausibility.tracks import Followed, follow_once
from spslam.datasets.plausibility.views import View

# As MAX_COLOR_DELAY_S of spslam/slam/color_motion.py: tracking measures smaller ones.
_LEAST_LAG_S = 0.1
_MOST_SECONDS = 5.0  # from view to view; larger steps come from other units
_MOST_LAG, _LAG_STEP = 4.0, 0.25  # in views
_LEAST_PAIRS, _LEAST_POINTS = 10, 30
# The median difference of turns: at the lag found, as a share of what it is without, and as a share of the turns; of
# the larger half of the turns too, as small ones agree at any lag where depth shows none.
_BETTER, _EXPLAINED = 0.5, 0.4


def lag_findings(views: Sequence[View], lens: Lens, followed: Followed | None = None) -> list[Finding]:
    """Whether color and depth images look taken at different times; a doubt.

    Args:
        views: two or more, in order; nothing is said where their time stamps can't be seconds.
        lens: as the recording says.
        followed: as of `follow`.
    """
    between = float(np.median(np.diff([view.timestamp for view in views])))
    if not 0 < between < _MOST_SECONDS:
        return []
    followed = followed or Followed()
    color, depth = _turns_of_color(views, lens, followed), _turns_of_depth(views, lens, followed)
    lags = np.arange(-_MOST_LAG, _MOST_LAG + _LAG_STEP / 2, _LAG_STEP)
    apart = np.array([np.median(_differences(color, depth, lag)) for lag in lags])
    if not np.isfinite(apart).any():
        return []
    best, given = int(np.nanargmin(apart)), apart[len(lags) // 2]
    seconds = lags[best] * between
    is_inside = 0 < best < len(lags) - 1
    turned = np.linalg.norm(color, axis=1)
    is_clear = apart[best] < _BETTER * given and apart[best] < _EXPLAINED * float(np.nanmedian(turned))
    if not is_inside or not is_clear or abs(seconds) < _LEAST_LAG_S:
        return []
    large = turned >= np.nanmedian(turned)
    if not np.median(_differences(color, depth, lags[best], large)) < _EXPLAINED * float(np.median(turned[large])):
        return []
    order = "before" if seconds < 0 else "after"
    text = f"color images look taken {abs(seconds):.2f} s {order} their depth images, by how both turn"
    return [Finding("pairing", text, "pair each color image with the depth image of the same time")]


def _turns_of_color(views: Sequence[View], lens: Lens, followed: Followed) -> np.ndarray:
    """Rotation vectors float64 [V - 1, 3] from view to view by points of color, NaN where too few were followed."""
    turns, points, rows = np.full((len(views) - 1, 3), np.nan), [], []
    for row, pixels in enumerate(follow_once(views, followed)):
        depth = depth_at(views[row].depth, pixels[0])
        known = depth > 0
        if np.count_nonzero(known) >= _LEAST_POINTS:
            points.append(Points(pixels[0][known], depth[known], pixels[1][known]))
            rows.append(row)
    for row, fit in zip(rows, fit_flows(points, lens), strict=True):
        turns[row] = _vector(fit.rotation)
    return turns


def _turns_of_depth(views: Sequence[View], lens: Lens, followed: Followed) -> np.ndarray:
    """The same by depth images alone, NaN where too little overlaps."""
    for row in range(len(followed.turns), len(views) - 1):
        first, last = (Surface.of(view.depth, lens) for view in views[row : row + 2])
        fit = fit_surfaces(first, last, lens, np.eye(4))
        followed.turns[row] = np.full(3, np.nan) if fit is None else _vector(fit.motion[:3, :3])
    return np.array([followed.turns[row] for row in range(len(views) - 1)])


def _vector(rotation: np.ndarray) -> np.ndarray:
    return cv2.Rodrigues(rotation)[0][:, 0]


def _differences(color: np.ndarray, depth: np.ndarray, lag: float, asked: np.ndarray | None = None) -> np.ndarray:
    """By how much turns of color and those of depth `lag` views later differ, float64 [N], rad; one NaN where few are
    known, of all or of those in rows `asked`."""
    at = np.arange(len(color)) + lag
    whole = np.floor(at).astype(int)
    inside = (whole >= 0) & (whole + (at > whole) < len(depth))
    least = _LEAST_PAIRS
    if asked is not None:
        inside, least = inside & asked, _LEAST_PAIRS // 2
    before, share = depth[whole[inside]], (at - whole)[inside, None]
    after = depth[np.minimum(whole[inside] + 1, len(depth) - 1)]
    between = np.where(share > 0, (1 - share) * before + share * after, before)
    apart = np.linalg.norm(color[inside] - between, axis=1)
    known = apart[np.isfinite(apart)]
    return known if len(known) >= least else np.array([np.nan])
