"""Ground-truth poses against how images and depth move: conventions, mirrored images, and the scale of depth."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from spslam.datasets.base import RgbdDataset
from spslam.datasets.findings import Finding
from spslam.datasets.plausibility.flow_fit import FlowFit
from spslam.datasets.plausibility.lens import Lens
from spslam.datasets.plausibility.tracks import Segment
from spslam.datasets.plausibility.views import Stretch
from spslam.geometry import inverse, rotation_angle

_LEAST_TURN = np.radians(2.0)
_LEAST_SEGMENTS = 2
# Differences of rotation as a share of the rotation.
_AGREES, _DISAGREES, _EXPLAINED = 0.25, 0.6, 0.4
# Segments whose translation is at least this share of the median depth show the scale of depth, if the poses agree on
# its direction: else it is the poses that are inaccurate.
_BASELINE, _SAME_DIRECTION = 0.02, 0.99
_LEAST_ERROR = 0.02
_MATTERS, _CERTAIN_SIGMAS = 0.035, 5.0
_MODEL_ERROR, _UNREGISTERED_ERROR = 0.008, 0.06


def pose_findings(
    stretch: Stretch, segments: Sequence[Segment], fits: Sequence[FlowFit], lens: Lens, dataset: RgbdDataset
) -> list[Finding]:
    """What speaks against the poses, or against depth.

    Args:
        stretch: the views.
        segments: pairs of views.
        fits: the motion of each by optical flow.
        lens: as the recording says.
        dataset: what all is of: whether depth is registered to color, and how its scale is set.
    """
    if stretch.poses is None:
        return []
    known = np.isfinite(stretch.poses).all(axis=(1, 2))
    pairs = [
        (segment, fit)
        for segment, fit in zip(segments, fits, strict=True)
        if known[segment.first] and known[segment.last]
    ]
    turned = [rotation_angle(fit.rotation) for _, fit in pairs]
    if len(pairs) >= _LEAST_SEGMENTS and sum(turned) > _LEAST_TURN:
        shares = {
            name: _disagreement(stretch.poses, pairs, reading, lens.median_m) for name, reading in _READINGS.items()
        }
        given = shares[_AS_THEY_ARE]
        if given > _AGREES:
            explained = min(shares.values()) < _EXPLAINED * given
            return [_convention(shares)] if explained or given > _DISAGREES else []
    return _scale_findings(stretch.poses, pairs, lens, dataset)


def _disagreement(
    poses: np.ndarray,
    pairs: Sequence[tuple[Segment, FlowFit]],
    reading: Callable[[np.ndarray], np.ndarray],
    depth_m: float,
) -> float:
    """How far motions by poses are from those by images (angles, directions of translation), as a share of these."""
    read = reading(poses)
    apart, moved = 0.0, 0.0
    for segment, fit in pairs:
        motion = inverse(read[segment.last]) @ read[segment.first]
        length = float(np.linalg.norm(fit.translation))
        by_poses = motion[:3, 3] * length / max(float(np.linalg.norm(motion[:3, 3])), 1e-9)
        apart += (
            float(rotation_angle(fit.rotation.T @ motion[:3, :3]))
            + float(np.linalg.norm(by_poses - fit.translation)) / depth_m
        )
        moved += float(rotation_angle(fit.rotation)) + length / depth_m
    return apart / moved


def _convention(shares: dict[str, float]) -> Finding:
    name = min(shares, key=lambda name: shares[name])
    if shares[name] > _AGREES:
        text = "the ground-truth poses do not fit how the images move"
        return Finding(
            "poses", text, "check their order, their time stamps and their convention (camera to world, OpenCV axes)"
        )
    if name in _MIRRORED:
        return Finding("mirrored", f"by the ground-truth poses {name}", "mirror color and depth back", certain=True)
    return Finding("poses", name, "convert the poses, or evaluate without them")


def _scale_findings(
    poses: np.ndarray, pairs: Sequence[tuple[Segment, FlowFit]], lens: Lens, dataset: RgbdDataset
) -> list[Finding]:
    """Translations by the poses against those by images and depth, whose unit is that of depth."""
    logs, errors = [], []
    for segment, fit in pairs:
        by_poses = (inverse(poses[segment.last]) @ poses[segment.first])[:3, 3]
        lengths = np.linalg.norm(by_poses), np.linalg.norm(fit.translation)
        if lengths[1] > _BASELINE * lens.median_m and lengths[0] > 0:
            cosine = min(float(by_poses @ fit.translation / (lengths[0] * lengths[1])), 1.0)
            if cosine > _SAME_DIRECTION:
                logs.append(float(np.log(lengths[0] / lengths[1])))
                # Lengths are no better than directions are.
                errors.append(max(np.sqrt(1 - cosine**2), _LEAST_ERROR))
    if len(logs) < _LEAST_SEGMENTS:
        return []
    weights = 1 / np.square(errors)
    mean = float(np.average(logs, weights=weights))
    spread = float(np.sum(weights * np.square(np.array(logs) - mean))) / (len(logs) - 1)
    model_error = _MODEL_ERROR if dataset.is_registered else _UNREGISTERED_ERROR
    sigma = float(np.hypot(np.sqrt(max(spread, 1.0) / weights.sum()), model_error))
    if abs(mean) < _MATTERS or abs(mean) < _CERTAIN_SIGMAS * sigma:
        return []
    text = f"depth and ground-truth poses disagree: depth {np.exp(mean):.3g} times as large would fit (+- {sigma:.0%})"
    return [Finding("scale", text, f"{dataset.scale_remedy}, or correct the unit of the poses", certain=True)]


def _conjugated(*signs: float) -> Callable[[np.ndarray], np.ndarray]:
    """Poses of a world seen in a mirror."""
    mirror = np.diag([*signs, 1.0])
    return lambda poses: mirror @ poses @ mirror


def _inverted(poses: np.ndarray) -> np.ndarray:
    known = np.isfinite(poses).all(axis=(1, 2))
    inverted = poses.copy()
    inverted[known] = inverse(poses[known])
    return inverted


_FLIP = np.diag([1.0, -1.0, -1.0, 1.0])
_AS_THEY_ARE = "as they are"
_MIRRORED = {
    "the images are mirrored left to right": _conjugated(-1, 1, 1),
    "the images are mirrored upside down": _conjugated(1, -1, 1),
}
_READINGS: dict[str, Callable[[np.ndarray], np.ndarray]] = {
    _AS_THEY_ARE: lambda poses: poses,
    "the poses look like world-to-camera; camera-to-world is needed": _inverted,
    "the poses look like OpenGL axes (y up, z backward); OpenCV axes are needed": lambda poses: poses @ _FLIP,
    "the poses look like world-to-camera in OpenGL axes": lambda poses: _inverted(poses) @ _FLIP,
    "the images look turned by 180 degrees against the poses": lambda poses: poses @ np.diag([-1.0, -1.0, 1.0, 1.0]),
    **_MIRRORED,
}
