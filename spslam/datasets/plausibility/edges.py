"""Where the edges of depth lie on those of color: registered, shifted, scaled, turned or mirrored.

Objects that end before something farther nearly always end in color too, so over many views the edges of depth meet
more of color where both images are of one camera and one time. Works on images of half the views' size.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from spslam.datasets.plausibility.views import View

# An edge of depth: what is behind is farther by this share within some pixels (a shadow may lie between).
_EDGE_SHARE, _NEXT_SHARE = 0.15, 0.08
_EDGE_WINDOW_PX = 5
_BORDER_PX = 4
_STRONG_COLOR_PERCENTILE = 85
_MOST_STRENGTH = 1.5
_BACKGROUND_PX = 31
_MOST_VIEWS = 10
_LEAST_EDGE_PX = 500
_LEAST_QUARTER_PX, _LEAST_QUARTERS = 150, 3
# How far color's edges are looked for, as a share of the width.
_REACH = 0.14
_CLEAR_SCORE = 0.15
SAME_PLACE = 0.015
_NEARLY_BEST = 0.8


@dataclass(frozen=True)
class EdgeMatch:
    """How edges of depth find edges of color; scores are color's strength there, in units of a strong edge.

    Attributes:
        score: where they are.
        best_score: with each quarter of the image at its best offset.
        displacement: the largest that this takes within the image, as a share of the width.
        least_offset: the smallest of the quarters' offsets, as a share of the width.
        misfit: how far the quarters' offsets are from one shift, scale and rotation, as a share of the width.
        similarity: float64 [4], the shift to the right and down as shares of the width, then s cos a - 1 and s sin a of
            the scale s and the angle a (clockwise), about the middle of the image.
        turned_scores: by name, with the depth image mirrored or turned.
    """

    score: float
    best_score: float
    displacement: float
    least_offset: float
    misfit: float
    similarity: np.ndarray
    turned_scores: dict[str, float]

    @property
    def is_registered(self) -> bool:
        """Whether color and depth clearly fit where they are."""
        if self.score < _CLEAR_SCORE:
            return False
        return self.displacement <= SAME_PLACE or self.score > _NEARLY_BEST * self.best_score

    def moved(self, depth: np.ndarray) -> np.ndarray:
        """A depth image [H, W], m, with its edges at their best offset; 0 where it has nothing to show then."""
        height, width = depth.shape
        right, down, larger, turn = self.similarity
        linear = np.array([[1 + larger, -turn], [turn, 1 + larger]])
        middle = np.array([(width - 1) / 2, (height - 1) / 2])
        to = middle + width * np.array([right, down]) - linear @ middle
        return cv2.warpAffine(depth, np.column_stack((linear, to)), (width, height), flags=cv2.INTER_NEAREST)


def match_edges(views: Sequence[View]) -> EdgeMatch | None:
    """Compares edges of color and depth; None where depth has too few of them.

    Args:
        views: of a stretch, in order.
    """
    chosen = [views[k] for k in np.unique(np.linspace(0, len(views) - 1, _MOST_VIEWS).astype(int))]
    color, depth = [_color_edges(view.gray) for view in chosen], [_depth_edges(view.depth) for view in chosen]
    both = list(zip(color, depth, strict=True))
    count = sum(float(edges.sum()) for edges in depth)
    if count < _LEAST_EDGE_PX:
        return None
    score = sum(float(np.vdot(*pair)) for pair in both) / count
    turned = {
        name: sum(float(np.vdot(strength, np.ascontiguousarray(turn(edges)))) for strength, edges in both) / count
        for name, turn in TURNS.items()
    }
    quarters = [_best_offset(color, depth, quarter) for quarter in _quarters(*color[0].shape)]
    found = [quarter for quarter in quarters if quarter is not None]
    best, displacement, least, misfit, similarity = score, 0.0, 0.0, 1.0, np.zeros(4)
    if len(found) >= _LEAST_QUARTERS:
        best = float(np.mean([quarter[2] for quarter in found]))
        similarity, displacement, misfit = _similarity(np.array([quarter[:2] for quarter in found]), color[0].shape)
        least = min(float(np.hypot(*quarter[1])) for quarter in found) / color[0].shape[1]
    return EdgeMatch(score, best, displacement, least, misfit, similarity, turned)


TURNS = {
    "mirrored left to right": lambda image: image[:, ::-1],
    "upside down": lambda image: image[::-1],
    "turned by 180 degrees": lambda image: image[::-1, ::-1],
}


def _quarters(height: int, width: int) -> list[tuple[slice, slice]]:
    rows = (slice(0, height // 2), slice(height // 2, height))
    columns = (slice(0, width // 2), slice(width // 2, width))
    return [(row, column) for row in rows for column in columns]


def _best_offset(
    color: Sequence[np.ndarray], depth: Sequence[np.ndarray], quarter: tuple[slice, slice]
) -> tuple[np.ndarray, np.ndarray, float] | None:
    """Center of a quarter's edges and their best offset, both [2] px, and the score there."""
    height, width = color[0].shape
    reach = max(2, round(_REACH * width))
    rows, columns = quarter
    total, count, moment = np.zeros((2 * reach + 1, 2 * reach + 1)), 0.0, np.zeros(2)
    for strength, edges in zip(color, depth, strict=True):
        part = edges[rows, columns]
        padded = cv2.copyMakeBorder(strength, reach, reach, reach, reach, cv2.BORDER_CONSTANT, value=0.0)
        window = padded[rows.start : rows.stop + 2 * reach, columns.start : columns.stop + 2 * reach]
        total += cv2.matchTemplate(window, part, cv2.TM_CCORR)
        count += float(part.sum())
        v, u = np.nonzero(part)
        moment += (float(u.sum()), float(v.sum()))
    if count < _LEAST_QUARTER_PX:
        return None
    row, column = np.unravel_index(int(np.argmax(total)), total.shape)
    center = moment / count + (columns.start, rows.start) - ((width - 1) / 2, (height - 1) / 2)
    return center, np.array([column - reach, row - reach], np.float64), float(total.max()) / count


def _similarity(found: np.ndarray, shape: tuple[int, ...]) -> tuple[np.ndarray, float, float]:
    """A shift, scale and rotation fitted to offsets, their largest displacement in the image, and the misfit.

    Args:
        found: [Q, 2, 2], centers and offsets, px.
        shape: of the image.

    Returns:
        As in `EdgeMatch`.
    """
    (x, y), offsets = found[:, 0].T, found[:, 1]
    one, zero = np.ones(len(x)), np.zeros(len(x))
    columns = np.concatenate((np.column_stack((one, zero, x, -y)), np.column_stack((zero, one, y, x))))
    wanted = np.concatenate(offsets.T)
    shift_x, shift_y, scale, turn = solution = np.linalg.lstsq(columns, wanted, rcond=None)[0]
    misfit = float(np.sqrt(np.mean((columns @ solution - wanted) ** 2)))
    height, width = shape
    corners = [(sx * width / 2, sy * height / 2) for sx in (-1, 1) for sy in (-1, 1)]
    moved = [np.hypot(shift_x + scale * u - turn * v, shift_y + scale * v + turn * u) for u, v in corners]
    return np.array([shift_x / width, shift_y / width, scale, turn]), float(max(moved)) / width, misfit / width


def _color_edges(gray: np.ndarray) -> np.ndarray:
    """Strength of edges against what is around, float32 [h / 2, w / 2]."""
    smooth = cv2.resize(gray, _half(gray), interpolation=cv2.INTER_AREA).astype(np.float32)
    strength = np.hypot(cv2.Sobel(smooth, cv2.CV_32F, 1, 0), cv2.Sobel(smooth, cv2.CV_32F, 0, 1))
    strong = float(np.percentile(strength, _STRONG_COLOR_PERCENTILE)) + 1e-3
    relative = np.minimum(strength / strong, _MOST_STRENGTH)
    return relative - cv2.blur(relative, (_BACKGROUND_PX, _BACKGROUND_PX))


def _depth_edges(depth: np.ndarray) -> np.ndarray:
    """1 on the near side of edges, float32 [h / 2, w / 2]."""
    small = cv2.resize(depth, _half(depth), interpolation=cv2.INTER_NEAREST)
    known = small > 0
    farther = cv2.dilate(small, np.ones((_EDGE_WINDOW_PX, _EDGE_WINDOW_PX), np.uint8))
    beside = cv2.dilate(np.where(known, small, np.float32(1e9)), np.ones((3, 3), np.uint8))
    edge = known & (farther > (1 + _EDGE_SHARE) * small) & (beside > (1 + _NEXT_SHARE) * small)
    edge[:_BORDER_PX] = edge[-_BORDER_PX:] = False
    edge[:, :_BORDER_PX] = edge[:, -_BORDER_PX:] = False
    return edge.astype(np.float32)


def _half(image: np.ndarray) -> tuple[int, int]:
    return max(image.shape[1] // 2, 1), max(image.shape[0] // 2, 1)
