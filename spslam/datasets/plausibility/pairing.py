"""Does the depth image belong to the color image? Mirrored, turned, shifted, inverted depth, or that of another time.

Points of the color image move by how far away they are. So the depth that explains their motion is theirs: each other
reading of the depth image that occurs in practice is tried, and named if it explains the motion clearly better. Where
the camera only turns, motion says nothing, and the edges of the images decide, unless it speaks against what they say:
a few edges without contrast may lie beside stronger ones by chance.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from spslam.datasets.findings import Finding
from spslam.datasets.plausibility.edges import SAME_PLACE, TURNS, EdgeMatch
from spslam.datasets.plausibility.flow_fit import Points, depth_at, fit_flows
from spslam.datasets.plausibility.lens import Lens
from spslam.datasets.plausibility.tracks import Segment
from spslam.datasets.plausibility.views import View

# Errors are compared by their logs, so that segments count alike; this much is noise of tracks.
_NOISE_PX = 0.03
# Sums over segments of the log of errors: another reading must be better by so much, in so many segments.
_BETTER, _LEAST_SEGMENTS = 1.5, 2
_BETTER_EACH = 0.25
_LEAST_POINTS = 30
# Depth that fits this well leaves nothing to be explained.
_FITS_PX = 0.25
_MOST_SEGMENTS = 6
_EDGES_BETTER, _EDGES_CLEAR, _EDGES_CERTAIN = 0.12, 0.2, 0.3
# As shares of the width. Color that is so far from its depth is another camera's.
_DOUBTFUL_OFFSET, _CERTAIN_OFFSET = 0.04, 0.045
_EDGES_LEFT, _MOST_MISFIT = 0.5, 0.01
# Sum over segments of the log of errors by which depth where edges want it is worse than depth as it is.
_CONTRADICTED = 0.2

Reading = Callable[[Sequence[View], int], np.ndarray | None]


def pairing_findings(
    views: Sequence[View], segments: Sequence[Segment], lens: Lens, edges: EdgeMatch | None
) -> list[Finding]:
    """What speaks for another reading of depth.

    Args:
        views: of the stretch.
        segments: pairs of views.
        lens: as the recording says.
        edges: None where there are too few.
    """
    longest = sorted(segments, key=lambda segment: segment.first - segment.last)[:_MOST_SEGMENTS]
    by_motion = _better_reading(views, longest, lens)
    if by_motion is not None:
        return [by_motion]
    by_edges = None if edges is None else _turned_edges(edges) or _moved_edges(edges)
    if by_edges is None:
        return []
    finding, reading = by_edges
    (gains,) = _gains(views, longest, lens, [reading])
    return [] if sum(gain for gain in gains if gain is not None) < -_CONTRADICTED else [finding]


def _better_reading(views: Sequence[View], longest: Sequence[Segment], lens: Lens) -> Finding | None:
    best: tuple[float, Finding] | None = None
    if _median_error(views, longest, lens) < _FITS_PX:
        return None
    all_gains = _gains(views, longest, lens, [reading for reading, _ in _READINGS.values()])
    for (name, (_, remedy)), gains in zip(_READINGS.items(), all_gains, strict=True):
        known = np.array([gain for gain in gains if gain is not None])
        if len(known) < _LEAST_SEGMENTS or np.median(known) < _BETTER_EACH or known.sum() < _BETTER:
            continue
        if best is None or known.sum() > best[0]:
            better = f"{np.exp(np.median(known)):.1f} times as well"
            text = f"depth does not belong to color: {name} would explain how color moves {better}"
            best = float(known.sum()), Finding("pairing", text, remedy, certain=True)
    return None if best is None else best[1]


def _median_error(views: Sequence[View], segments: Sequence[Segment], lens: Lens) -> float:
    found = []
    for segment in segments:
        depth = depth_at(views[segment.first].depth, segment.pixels_first)
        known = depth > 0
        if np.count_nonzero(known) >= _LEAST_POINTS:
            found.append(_points(segment, depth, known))
    return float(np.median([fit.error_px for fit in fit_flows(found, lens)])) if found else 0.0


def _gains(
    views: Sequence[View], segments: Sequence[Segment], lens: Lens, readings: Sequence[Reading]
) -> list[list[float | None]]:
    """For each reading, log of how many times smaller each segment's error is with it; None where too few points have
    both depths."""
    given = [depth_at(views[segment.first].depth, segment.pixels_first) for segment in segments]
    found: list[Points] = []
    is_known = []
    for reading in readings:
        for segment, depth in zip(segments, given, strict=True):
            other = reading(views, segment.first)
            changed = 0 * depth if other is None else depth_at(np.ascontiguousarray(other), segment.pixels_first)
            known = (depth > 0) & (changed > 0)
            is_known.append(np.count_nonzero(known) >= _LEAST_POINTS)
            if is_known[-1]:
                found += [_points(segment, each, known) for each in (depth, changed)]
    logs = [float(np.log(fit.error_px + _NOISE_PX)) for fit in fit_flows(found, lens)]
    gains = (before - after for before, after in zip(logs[::2], logs[1::2], strict=True))
    each = [next(gains) if known else None for known in is_known]
    return [each[k * len(segments) : (k + 1) * len(segments)] for k in range(len(readings))]


def _points(segment: Segment, depth: np.ndarray, known: np.ndarray) -> Points:
    return Points(segment.pixels_first[known], depth[known], segment.pixels_last[known])


def _turned(name: str) -> Reading:
    return lambda views, view: TURNS[name](views[view].depth)


def _constant(views: Sequence[View], view: int) -> np.ndarray:
    depth = views[view].depth
    return np.where(depth > 0, np.float32(np.median(depth[depth > 0])), np.float32(0)) if depth.any() else depth


def _reciprocal(views: Sequence[View], view: int) -> np.ndarray:
    """Disparity taken for depth."""
    depth = views[view].depth
    known = depth > 0
    return np.where(known, np.float32(1) / np.maximum(depth, 1e-3), np.float32(0)).astype(np.float32)


def _near_for_far(views: Sequence[View], view: int) -> np.ndarray:
    depth = views[view].depth
    known = depth > 0
    if not known.any():
        return depth
    near, far = np.percentile(depth[known], (1, 99))
    return np.where(known, np.maximum(near + far - depth, near / 2), 0).astype(np.float32)


def _of_view(step: int) -> Reading:
    def reading(views: Sequence[View], view: int) -> np.ndarray | None:
        return views[view + step].depth if 0 <= view + step < len(views) else None

    return reading


def _when(lag: int) -> str:
    return "later" if lag > 0 else "earlier"


_REGISTER = "both images of a frame must be of the same view"
_TIME = "pair each color image with the depth image of the same time"
_READINGS: dict[str, tuple[Reading, str]] = {
    **{f"a depth image {name}": (_turned(name), f"turn one of the two: {_REGISTER}") for name in TURNS},
    "the same depth everywhere": (_constant, "check what the depth images hold, and that they are of the same view"),
    "inverse depth (a disparity)": (_reciprocal, "convert it: depth = focal length * baseline / disparity"),
    "depth with near and far exchanged": (_near_for_far, "convert it to meters along the optical axis"),
    **{f"the depth image {abs(k)} views {_when(k)}": (_of_view(k), _TIME) for k in (-6, -3, 3, 6)},
}


def _turned_edges(edges: EdgeMatch) -> tuple[Finding, Reading] | None:
    """What edges say of a depth image that was turned over, and that reading of it."""
    name = max(edges.turned_scores, key=lambda name: edges.turned_scores[name])
    turned = edges.turned_scores[name]
    if turned <= edges.score + _EDGES_BETTER or turned <= _EDGES_CLEAR or turned <= 0.9 * edges.best_score:
        return None
    text = f"depth does not belong to color: its edges lie on color's where the depth image is {name}"
    return Finding("pairing", text, f"turn one of the two: {_REGISTER}", certain=True), _turned(name)


def _moved_edges(edges: EdgeMatch) -> tuple[Finding, Reading] | None:
    """What edges say of depth that is not where color is, and depth where they want it."""
    far, moved = edges.displacement, edges.score < _EDGES_LEFT * edges.best_score
    if far < _DOUBTFUL_OFFSET or edges.best_score < _EDGES_CLEAR or not moved or edges.misfit > _MOST_MISFIT:
        return None
    if edges.least_offset <= SAME_PLACE:
        return None  # a part of the image where they do lie on each other: of the rest chance, or texture, is likelier
    text = f"color and depth are not registered: their edges are up to {100 * far:.0f} % of the width apart"
    certain = far > _CERTAIN_OFFSET and edges.best_score > _EDGES_CERTAIN
    finding = Finding("registration", text, "register depth to the color camera (or color to depth)", certain)
    return finding, lambda views, view: edges.moved(views[view].depth)
