"""Depth values, repeated images, and the order of views: what shows without geometry."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import cv2
import numpy as np

from spslam.datasets.findings import Finding
from spslam.datasets.folder import PLAUSIBLE_MEDIAN_M
from spslam.datasets.frozen_depth import has_moved
from spslam.datasets.plausibility.views import Stretch, View

# Beyond it the depth scale may be wrong; beyond `PLAUSIBLE_MEDIAN_M` it is.
_UNUSUAL_MEDIAN_M = (0.25, 9.0)
# Ratios between depth scales in use (units per meter: 1, 1000, 4000, 5000, 6553.5, 10000).
_SCALES = (0.001, 0.1, 0.2, 0.25, 0.1526, 4.0, 5.0, 6.5535, 10.0, 1000.0)
_LIKELY_MEDIAN_M = (0.5, 5.0)
_FEW_IN_RANGE, _HALF_IN_RANGE = 0.05, 0.5
_ONE_VALUE_SPAN = 1e-3
# Neighboring pixels of a depth image seldom differ by so much: at edges only, 1 to 6 % of the pairs.
_JUMP, _MANY_JUMPS = 0.25, 0.4
# What is wrong with the way depth is stored shows in all views; a lens that is covered for a while does not.
_NEARLY_ALL = 0.9
# Eight bits hold 256 values; a depth image has thousands, where its units are fine.
_EIGHT_BITS, _LEAST_SPAN_M, _LEAST_PIXELS = 260, 1.0, 10_000
_COARSE_STEP_M, _EVEN = 0.01, 1.3
_VIEWS_FOR_VALUES = 3
_MOST_STEPS_SHARE, _HALF_OF_STEPS, _SOME_STEPS_SHARE = 0.8, 0.5, 0.15
# Poses of a camera that stands differ by less.
_STANDING_M = 0.002
_LEAST_STEPS = 5
# Depth has moved if the mean of a cell changes by this share in the median.
_DEPTH_MOVED = 0.02
_CELLS = (16, 12)
# A color image whose brightness varies by less shows nothing.
_BLANK_LEVELS = 3.0
# No camera takes frames faster, and a hand-held one that takes them more slowly shows other things each time.
_STEPS_S = (0.001, 5.0)
_USUAL_STEP_S = 1 / 30
_UNITS = (("milliseconds", 1e-3), ("microseconds", 1e-6), ("nanoseconds", 1e-9), ("minutes", 60.0), ("hours", 3600.0))
# A row of a thumbnail is as dark at least for the contrast in it.
_DARK_LEVELS = 8.0
# A view fits better after an earlier one: correlation distances of thumbnails.
_MUCH_NEARER, _FAR_STEPS = 0.5, 1.5
_THUMBNAIL = (32, 24)
_OUT_OF_ORDER_CERTAIN, _OUT_OF_ORDER_DOUBTFUL, _MOSTLY_APART = 0.3, 0.1, 0.5
# Some jumps are the camera's: it was covered, or the recording has gaps.
_LEAST_ASTRAY = 5
# Of shuffled views, steps are about as long as between any two views, and longer than a shaking camera makes.
_AS_ANY_TWO, _LONG_STEP = 0.7, 0.1


def depth_findings(stretch: Stretch, depth_range: tuple[float, float], scale_remedy: str) -> list[Finding]:
    """What is wrong with the values of depth.

    Args:
        stretch: the views.
        depth_range: of the dataset, m.
        scale_remedy: of the dataset.
    """
    known = stretch.known_depth()
    if not len(known):
        return [Finding("depth", "no depth at all in the frames looked at")]  # the lens may be covered; a run waits
    near, median, far = (float(value) for value in np.percentile(known[:: max(1, len(known) // 100_000)], (1, 50, 99)))
    if not PLAUSIBLE_MEDIAN_M[0] <= median <= PLAUSIBLE_MEDIAN_M[1]:
        text = f"median depth of {median:.3g} m: the depth scale looks wrong"
        # A hand before the lens is near, too, but not in all views.
        certain = median > PLAUSIBLE_MEDIAN_M[1] or _share_of(stretch.views, _is_too_near) > _NEARLY_ALL
        return [Finding("scale", text, scale_remedy + _fitting_scales(median), certain)]
    if far - near < _ONE_VALUE_SPAN * median:
        return [Finding("depth", f"all depth is the same, {median:.3g} m", _CONVERT, len(known) >= _LEAST_PIXELS)]
    findings = _value_findings(stretch.views, far - near)
    inside = float(np.mean([view.range_share for view in stretch.views if view.known_share > 0]))
    if inside < _HALF_IN_RANGE:
        text = (
            f"{1 - inside:.0%} of the depth lies outside dataset.min_depth_m ({depth_range[0]:g} m) to "
            f"dataset.max_depth_m ({depth_range[1]:g} m), median {median:.3g} m"
        )
        remedy = f"if the place is that deep, set them; else {scale_remedy}{_fitting_scales(median)}"
        findings.append(Finding("scale", text, remedy, inside < _FEW_IN_RANGE))
    elif not _UNUSUAL_MEDIAN_M[0] <= median <= _UNUSUAL_MEDIAN_M[1]:
        text = f"median depth of {median:.3g} m is unusual indoors: the depth scale may be wrong"
        findings.append(Finding("scale", text, scale_remedy + _fitting_scales(median)))
    return findings


def _share_of(views: Sequence[View], holds: Callable[[np.ndarray], bool]) -> float:
    """Share of the views with depth of whose depth image something holds."""
    return float(np.mean([holds(view.depth) for view in views if view.known_share > 0]))


def _is_too_near(depth: np.ndarray) -> bool:
    return float(np.median(depth[depth > 0])) < PLAUSIBLE_MEDIAN_M[0]


def _is_noise(depth: np.ndarray) -> bool:
    return _jump_share(depth) > _MANY_JUMPS


def _fitting_scales(median_m: float) -> str:
    low, high = _LIKELY_MEDIAN_M
    fitting = [scale for scale in _SCALES if low <= median_m * scale <= high]
    return f": depth {' or '.join(f'{scale:g}' for scale in fitting)} times as large would fit" if fitting else ""


_CONVERT = "check what the depth images hold: 16-bit or floating-point depth along the optical axis is needed"


def _value_findings(views: Sequence[View], span_m: float) -> list[Finding]:
    chosen = [views[k] for k in np.unique(np.linspace(0, len(views) - 1, _VIEWS_FOR_VALUES).astype(int))]
    jumps = [_jump_share(view.depth) for view in chosen]
    if np.median(jumps) > _MANY_JUMPS:
        text = f"depth is noise: {np.median(jumps):.0%} of the pixels differ from their neighbor by over {_JUMP:.0%}"
        remedy = "check how it is stored (byte order, bits, compression)"
        return [Finding("depth", text, remedy, _share_of(views, _is_noise) > _NEARLY_ALL)]
    known = np.concatenate([view.depth[view.depth > 0] for view in chosen])
    if len(known) < _LEAST_PIXELS or span_m < _LEAST_SPAN_M:
        return []
    values: np.ndarray = np.unique(known)
    if len(values) > _EIGHT_BITS or not _has_even_steps(values):
        return []
    step_cm = 100 * float(np.median(np.diff(values)))
    text = f"depth has only {len(values)} different values, {step_cm:.1f} cm apart: it looks stored in 8 bits"
    # A doubt: 16 bits in units of centimeters, as of a recording that reaches far, have the same values indoors.
    return [Finding("depth", f"{text} or in coarse units", _CONVERT)]


def _has_even_steps(values: np.ndarray) -> bool:
    """Whether values have gaps of one size, near and far; a sensor's grow with the square of depth."""
    gaps: np.ndarray = np.diff(values)
    half = len(gaps) // 2
    if half < 2 or np.median(gaps) < _COARSE_STEP_M:
        return False
    return bool(np.median(gaps[half:]) < _EVEN * np.median(gaps[:half]))


def _jump_share(depth: np.ndarray) -> float:
    left, right = depth[:, :-1], depth[:, 1:]
    both = (left > 0) & (right > 0)
    jumps = both & (np.abs(left - right) > _JUMP * np.minimum(left, right))
    return int(np.count_nonzero(jumps)) / max(int(np.count_nonzero(both)), 1)


def repetition_findings(stretch: Stretch, is_whole: bool) -> list[Finding]:
    """Frozen depth, frozen color, and frames that come again.

    Args:
        stretch: the views.
        is_whole: whether they are spread over the whole recording.
    """
    pairs = list(zip(stretch.views[:-1], stretch.views[1:], strict=True))
    if len(pairs) < _LEAST_STEPS:
        return []
    same_depth = np.array([a.signature.depth == b.signature.depth and a.signature.depth != 0 for a, b in pairs])
    same_color = np.array([a.color_checksum == b.color_checksum for a, b in pairs])
    shown = np.array([a.gray.std() > _BLANK_LEVELS for a, _ in pairs])
    color_moves = np.array([has_moved(b.signature.brightness, a.signature.brightness) for a, b in pairs])
    findings = []
    depth_frozen = float(np.mean(same_depth & ~same_color & color_moves))
    color_frozen = float(np.mean(same_color & shown & ~same_depth))
    if not any(_depth_moves(stretch.views[0], view) for view in stretch.views[1:]):
        color_frozen = 0.0
    both_frozen = float(np.mean(same_depth & same_color))
    if depth_frozen > _SOME_STEPS_SHARE:
        text = f"depth is frozen: {depth_frozen:.0%} of the views repeat the depth image with another color image"
        remedy = "pair each depth image once, with the color image nearest in time"
        findings.append(Finding("frozen depth", text, remedy, depth_frozen > _HALF_OF_STEPS))
    if color_frozen > _SOME_STEPS_SHARE:
        text = f"color is frozen: {color_frozen:.0%} of the views repeat the color image with another depth image"
        remedy = "pair each depth image with the color image nearest in time"
        findings.append(Finding("frozen color", text, remedy, color_frozen >= _MOST_STEPS_SHARE))
    text = f"{both_frozen:.0%} of the views are byte for byte the one before"
    moving = _poses_move(stretch, same_depth & same_color)
    if both_frozen > _MOST_STEPS_SHARE:
        text += ": the recording is frozen"
        findings.append(Finding("frozen", text, "record again, or begin where it moves (--frames)", is_whole or moving))
    elif both_frozen > _SOME_STEPS_SHARE:
        text += ": frames are repeated" + (" while the poses move" if moving else "")
        certain = moving and both_frozen > _HALF_OF_STEPS
        findings.append(Finding("frozen", text, "leave out the copies (dataset.stride)", certain))
    return findings


def _depth_moves(a: View, b: View) -> bool:
    first, second = (cv2.resize(view.depth, _CELLS, interpolation=cv2.INTER_AREA) for view in (a, b))
    known = (first > 0) & (second > 0)
    if not known.any():
        return False
    return float(np.median(np.abs(first - second)[known] / first[known])) > _DEPTH_MOVED


def _poses_move(stretch: Stretch, same: np.ndarray) -> bool:
    """Whether the poses move where the images stay the same [F - 1]."""
    if stretch.poses is None or not same.any():
        return False
    steps = np.linalg.norm(np.diff(stretch.poses[:, :3, 3], axis=0), axis=1)[same]
    return float(np.mean(steps > _STANDING_M)) > _MOST_STEPS_SHARE


def order_findings(views: Sequence[View]) -> list[Finding]:
    """Whether views would fit better elsewhere. Views that show nothing, as of a covered lens, have no place.

    Args:
        views: in the recording's order.
    """
    views = [view for view in views if view.gray.std() >= _BLANK_LEVELS]
    if len(views) < 2 * _LEAST_STEPS:
        return []
    distances = _distances(views)
    steps = np.diagonal(distances, 1)
    usual = float(np.median(steps))
    astray = 0
    for view in range(3, len(views)):
        step, earlier = steps[view - 1], distances[: view - 2, view].min()
        astray += bool(step > _FAR_STEPS * usual and earlier < _MUCH_NEARER * step)
    share, apart = astray / (len(views) - 3), _share_apart(distances)
    if share < _OUT_OF_ORDER_DOUBTFUL and apart < _MOSTLY_APART:
        return []
    text = f"the frames look out of order: {max(share, apart):.0%} of the views look like one that is not beside them"
    certain = share > _OUT_OF_ORDER_CERTAIN and astray >= _LEAST_ASTRAY
    certain |= apart > _MOSTLY_APART and usual > _LONG_STEP
    remedy = "name them so that they sort by time (000001, 000002, ...), or sort by time stamp"
    return [Finding("order", text, remedy, certain)]


def _share_apart(distances: np.ndarray) -> float:
    """Share of shuffled views that look much more like one elsewhere than like those beside them; 0 of others.

    Views of a camera that stands are all alike, and those of one that turns back are near the ones beside them too.

    Args:
        distances: [F, F] of the views.
    """
    steps = np.diagonal(distances, 1)
    if np.median(steps) < _AS_ANY_TWO * np.median(distances[np.triu_indices(len(distances), 1)]):
        return 0.0
    beside = np.minimum(np.append(steps, np.inf), np.insert(steps, 0, np.inf))
    others = np.where(np.eye(len(distances), dtype=bool), np.inf, distances)
    is_apart = np.abs(others.argmin(axis=1) - np.arange(len(distances))) > 2
    return float(np.mean(is_apart & (others.min(axis=1) < _MUCH_NEARER * beside)))


def _distances(views: Sequence[View]) -> np.ndarray:
    """1 - correlation of thumbnails, [F, F].

    Their rows are of the same brightness: light that flickers with the mains leaves bands, elsewhere in each image.
    """
    rows = []
    for view in views:
        small = cv2.resize(cv2.GaussianBlur(view.gray, (0, 0), 3), _THUMBNAIL, interpolation=cv2.INTER_AREA)
        of_rows = small.mean(axis=1, keepdims=True)
        row = ((small - of_rows) / np.maximum(of_rows, _DARK_LEVELS)).ravel()
        rows.append(row / max(float(np.linalg.norm(row)), 1e-6))
    table = np.stack(rows)
    return 1 - table @ table.T


def time_findings(timestamps: np.ndarray) -> list[Finding]:
    """Time stamps that do not ascend; the trajectory does not depend on them, but what it is compared with does.

    Args:
        timestamps: of all frames, s.
    """
    steps = np.diff(timestamps)
    wrong = int(np.count_nonzero(~(steps > 0)))
    if not wrong:
        return []
    text = f"{wrong} of {len(steps)} time stamps do not ascend, the first after frame {int(np.argmin(steps > 0))}"
    return [Finding("times", text, "sort the frames by time, or correct the time stamps")]


def unit_findings(timestamps: np.ndarray, has_overlap: bool) -> list[Finding]:
    """Time stamps in another unit than seconds, by their median step.

    Args:
        timestamps: of all frames, s.
        has_overlap: whether frames show what those before them do; frames of a camera that moves on for long do not.
    """
    steps = np.diff(timestamps)
    steps = steps[np.isfinite(steps) & (steps > 0)]
    step = float(np.median(steps)) if len(steps) else _USUAL_STEP_S
    if _STEPS_S[0] <= step and (step <= _STEPS_S[1] or not has_overlap):
        return []
    unit, seconds = min(_UNITS, key=lambda named: abs(np.log(step) + np.log(named[1] / _USUAL_STEP_S)))
    text = f"frames are {step:.3g} s apart by their time stamps: these look like {unit}, not seconds"
    return [Finding("time unit", text, f"multiply the time stamps by {seconds:g}")]
