"""Do the poses fit the depth? Depth carried from one view to another must meet the depth measured there.

Wrong conventions show: poses that are world-to-camera, OpenGL axes, another depth scale, frames sorted as text. Each of
them is tried, and the one that makes the depth images agree is named.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from spslam.camera import Camera
from spslam.geometry import inverse, rotation_angle, transform_points

# A pair of views must differ by one of these, or every reading of the poses agrees.
_MIN_TRANSLATION_M = 0.3
_MIN_ROTATION = np.radians(15)
_FARTHEST_PARTNER = 60
_PIXEL_STEP = 8
# Poses fit if depth agrees to this share of itself; another reading is named if it is twice as good.
_GOOD_RELATIVE_ERROR = 0.005
_CLEARLY_BETTER = 0.5
# Ratios between the depth scales in use (units a meter: 1000, 5000, 6553.5, 10000, 1).
_SCALES = (0.001, 0.1, 0.2, 0.5, 0.1526, 0.763, 1.311, 2.0, 5.0, 6.5535, 10.0, 1000.0)


@dataclass(frozen=True)
class DepthPair:
    """Two views.

    Attributes:
        frame_a: number of the first frame.
        frame_b: number of the second frame.
        depth_a: [H, W], m, 0 unknown.
        depth_b: [H, W], m, 0 unknown.
    """

    frame_a: int
    frame_b: int
    depth_a: np.ndarray
    depth_b: np.ndarray


@dataclass(frozen=True)
class Agreement:
    """How well depth agrees across views: medians over all points that fall into the other view.

    Attributes:
        median_cm: difference of depths.
        relative: difference as a share of the depth.
        overlap: share of the points that fall into the other view.
    """

    median_cm: float
    relative: float
    overlap: float


def choose_pairs(poses: np.ndarray, count: int) -> list[tuple[int, int]]:
    """Pairs of frames (i, j), i < j, spread over the sequence, whose views differ a little.

    Args:
        poses: [F, 4, 4], NaN where unknown; frames without pose are in no pair.
        count: most pairs. Fewer than two known poses give none.
    """
    known = np.flatnonzero(np.isfinite(poses).all(axis=(1, 2)))
    pairs = []
    for start in np.unique(np.linspace(0, max(len(known) - 2, 0), count).astype(int)):
        candidates = known[start + 1 : start + 1 + _FARTHEST_PARTNER]
        if len(candidates):
            pairs.append((int(known[start]), _partner(poses, int(known[start]), candidates)))
    return pairs


def measure_agreement(
    camera: Camera, pairs: Sequence[DepthPair], poses: np.ndarray, scale: float = 1.0
) -> Agreement | None:
    """Median difference between depth carried into a view and the depth measured there.

    Args:
        camera: of all views.
        pairs: as read by the caller.
        poses: [F, 4, 4] T_world_camera, indexed by the pairs' frame numbers.
        scale: factor on all depths.

    Returns:
        None if no point of any pair falls into the other view.
    """
    parts = [_differences(camera, pair, poses, scale) for pair in pairs]
    differences = np.concatenate([difference for difference, _, _ in parts] or [np.zeros(0)])
    if not len(differences):
        return None
    depths = np.concatenate([depth for _, depth, _ in parts])
    seen = sum(count for _, _, count in parts)
    return Agreement(
        100 * float(np.median(differences)), float(np.median(differences / depths)), len(differences) / max(seen, 1)
    )


def explain_disagreement(
    camera: Camera, pairs: Sequence[DepthPair], poses: np.ndarray, actual: Agreement | None
) -> str | None:
    """The reading of the poses that fits the depth clearly better, in words.

    Args:
        camera: of all views.
        pairs: as read by the caller.
        poses: [F, 4, 4] T_world_camera, as they are.
        actual: agreement of depth with these poses; None where no point falls into another view.

    Returns:
        None if the poses fit, or no other reading does.
    """
    if actual is not None and actual.relative < _GOOD_RELATIVE_ERROR:
        return None
    best, found = np.inf if actual is None else _CLEARLY_BETTER * _cost(actual), None
    for name, reading in _READINGS.items():
        agreement = measure_agreement(camera, pairs, reading(poses))
        if agreement is not None and _cost(agreement) < best:
            best, found = _cost(agreement), name
    for scale in _SCALES:
        agreement = measure_agreement(camera, pairs, poses, scale)
        if agreement is not None and _cost(agreement) < best:
            best, found = _cost(agreement), f"the depth scale looks wrong: depths {scale:g} times as large would fit"
    return found


def _cost(agreement: Agreement) -> float:
    # A reading that turns the views away from each other has few points left to disagree about.
    return agreement.relative / max(agreement.overlap, 1e-3)


def _partner(poses: np.ndarray, frame: int, candidates: np.ndarray) -> int:
    motion = inverse(poses[frame]) @ poses[candidates]
    far = np.linalg.norm(motion[:, :3, 3], axis=1) >= _MIN_TRANSLATION_M
    turned = rotation_angle(motion[:, :3, :3]) >= _MIN_ROTATION
    enough = np.flatnonzero(far | turned)
    return int(candidates[enough[0]] if len(enough) else candidates[-1])


def _differences(
    camera: Camera, pair: DepthPair, poses: np.ndarray, scale: float
) -> tuple[np.ndarray, np.ndarray, int]:
    """Absolute depth differences (m), the depths they are of, and how many points were carried over."""
    points = camera.unproject(pair.depth_a)[::_PIXEL_STEP, ::_PIXEL_STEP].reshape(-1, 3)
    points = scale * points[points[:, 2] > 0].astype(np.float64)
    motion = inverse(poses[pair.frame_b]) @ poses[pair.frame_a]
    points = transform_points(motion, points)
    u, v = np.nan_to_num(np.rint(camera.project(points)), nan=-1, posinf=-1, neginf=-1).clip(-1, 2**30).astype(int).T
    inside = (u >= 0) & (u < camera.width) & (v >= 0) & (v < camera.height)
    measured = scale * pair.depth_b[v[inside], u[inside]]
    carried = points[inside, 2]
    known = measured > 0
    return np.abs(carried - measured)[known], measured[known], len(points)


def _inverted(poses: np.ndarray) -> np.ndarray:
    known = np.isfinite(poses).all(axis=(1, 2))
    inverted = poses.copy()
    inverted[known] = inverse(poses[known])
    return inverted


def _sorted_as_text(poses: np.ndarray) -> np.ndarray:
    """Poses as they should be if row k was written for the k-th file name in text order (0, 1, 10, 100, 2, ...)."""
    order = np.array(sorted(range(len(poses)), key=str))
    numeric = np.empty_like(poses)
    numeric[order] = poses
    return numeric


_FLIP = np.diag([1.0, -1.0, -1.0, 1.0])
_READINGS: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    "the poses look like world-to-camera; camera-to-world is needed": _inverted,
    "the poses look like OpenGL axes (y up, z backward); OpenCV axes are needed": lambda poses: poses @ _FLIP,
    "the poses look like world-to-camera in OpenGL axes": lambda poses: _inverted(poses) @ _FLIP,
    "the poses look sorted as text (0, 1, 10, 11, ..., 2) and the images by number": _sorted_as_text,
    "the poses look one frame early": lambda poses: np.roll(poses, -1, axis=0),
    "the poses look one frame late": lambda poses: np.roll(poses, 1, axis=0),
}
