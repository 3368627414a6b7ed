"""Are focal length, principal point, distortion and the meaning of depth as the recording says?

The same seven numbers explain all segments of a stretch. Each segment's fit gives its estimate and its information, and
their sum decides; how much segments differ beyond that widens the error. So does a camera that turns one way: late
colors then shift all points alike, and a rolling shutter stretches images. One number is named if it alone explains
most.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from spslam.camera import Camera
from spslam.datasets.clock import LATE_S
from spslam.datasets.findings import Finding
from spslam.datasets.plausibility import lens as number
from spslam.datasets.plausibility.flow_fit import PRIOR, FlowFit, Points, fit_flows
from spslam.datasets.plausibility.lens import Lens

# Below these the trajectory suffers little, or real recordings are often that far off (rolling shutter, a color camera
# that is not quite where depth is registered to).
_MATTERS = np.array([0.025, 0.04, 0.025, 0.025, 0.05, 0.12, 0.04])
# Standard deviation of what the model leaves out: rolling shutter, smoothing of tracks, biased depth.
_MODEL_ERROR = np.array([0.005, 0.008, 0.005, 0.005, 0.012, 0.04, 0.015])
# Those that may also be off by the angle (rad) that the camera turns in `LATE_S`.
_SHOWS_TURN = np.isin(np.arange(number.COUNT), [number.FOCAL, number.ASPECT, number.SHIFT_X, number.SHIFT_Y])
CERTAIN_SIGMAS, DOUBTFUL_SIGMAS = 5.0, 4.0
PREFERRED_SIGMAS = 3.0  # doubtful where depth images alone agree, which have no part in the estimate
# Principal points farther from the given one, as a share of the image, are hardly a camera's: other things do not fit.
_LARGEST_SHIFT = 0.15
_LEAST_SEGMENTS = 2
# A group of numbers is large enough if it explains this share of what all seven do.
_EXPLAINED = 0.85
_MOST_NUMBERS = 3
# A focal length that is far off is only found from nearby.
_STARTS = (0.0, np.log(0.6), np.log(1.6), np.log(0.4), np.log(2.5))
_GOOD_START_PX = 0.5
_LEAST_ERROR_PX = 0.1
# Principal points are within some percent of the middle, those of cropped images within a quarter.
_CENTER_DOUBTFUL, _CENTER_CERTAIN = 0.2, 0.35


@dataclass(frozen=True)
class LensEstimate:
    """What segments say about the seven numbers.

    Attributes:
        lens: as the recording says.
        chosen: the numbers that explain most, by importance.
        values: float64 [7], theirs; 0 for others.
        sigmas: how many standard deviations they are from 0 together.
        focal: log of the factor on the focal length if that alone were off.
        sigma: float64 [7], standard deviation of each number if it alone were off and the camera did not turn.
        gain: how many times smaller errors in pixels are with other numbers.
    """

    lens: Lens
    chosen: tuple[int, ...]
    values: np.ndarray
    sigmas: float
    focal: float
    sigma: np.ndarray
    gain: float

    @property
    def matters(self) -> bool:
        """Whether one of the chosen numbers is off by enough to matter."""
        return any(abs(self.values[k]) > _MATTERS[k] for k in self.chosen)

    @property
    def corrected(self) -> Lens:
        """The lens with these numbers."""
        return self.lens.with_numbers(self.values)

    @property
    def is_settled(self) -> bool:
        """Whether further views would hardly change the judgment: a focal length that is off by 4 % would show."""
        small = self.sigma[number.FOCAL] < 0.008
        return small and (not self.matters or self.sigmas < 1.5 or self.sigmas > 2 * CERTAIN_SIGMAS)


def estimate_lens(segments: Sequence[Points], lens: Lens, seconds: Sequence[float]) -> LensEstimate | None:
    """What the segments say.

    Args:
        segments: points of each.
        lens: as the recording says.
        seconds: from the first view of each segment to its last, positive.

    Returns:
        None where there is no segment.
    """
    if not segments:
        return None
    start = _start(segments, lens)
    fits = fit_flows(segments, start, range(number.COUNT))
    information = np.sum([fit.information for fit in fits], axis=0)
    weighted = np.sum([fit.information @ fit.numbers for fit in fits], axis=0)
    with np.errstate(divide="ignore"):
        sigma = 1 / np.sqrt(np.maximum(np.diag(information), 1e-12))
    model_error = np.hypot(_MODEL_ERROR, LATE_S * _turning_speed(fits, seconds) * _SHOWS_TURN)
    chosen = _choose(information, weighted)
    values, sigmas = _judge(fits, chosen, model_error)
    focal = float(weighted[number.FOCAL] / max(information[number.FOCAL, number.FOCAL], 1e-12))
    given = float(np.mean([fit.error_px for fit in fit_flows(segments, lens)]))
    gain = given / max(float(np.mean([fit.error_px for fit in fits])), _LEAST_ERROR_PX)
    return LensEstimate(lens, chosen, values, sigmas, focal, np.hypot(sigma, _MODEL_ERROR), gain)


def lens_finding(estimate: LensEstimate, supported: bool, preferred: bool) -> Finding | None:
    """The estimate in words; None where all is well.

    Args:
        estimate: of a stretch.
        supported: whether the depth images, or the edges of depth in color, say that color and depth are one camera's:
            otherwise it may be their registration that is off.
        preferred: whether depth images lie better on one another with it.
    """
    camera = estimate.lens.camera
    shift = np.abs(estimate.corrected.center - estimate.lens.center) / (camera.width, camera.height)
    least_sigmas = PREFERRED_SIGMAS if preferred and shift.max() <= _LARGEST_SHIFT else DOUBTFUL_SIGMAS
    if not estimate.matters or estimate.sigmas < least_sigmas:
        return None
    certain = supported and estimate.sigmas >= CERTAIN_SIGMAS
    text, remedy = _words(estimate)
    if not supported:
        remedy += ", or register color and depth to each other"
    return Finding("intrinsics", text, remedy, certain)


def center_findings(camera: Camera) -> list[Finding]:
    """Whether the principal point is where no camera has it: the intrinsics are then of another image size.

    Args:
        camera: as the recording says.
    """
    shares = (camera.cx + 0.5) / camera.width, (camera.cy + 0.5) / camera.height
    off = max(abs(share - 0.5) for share in shares)
    if off < _CENTER_DOUBTFUL:
        return []
    text = f"the principal point lies at {shares[0]:.0%} of the width and {shares[1]:.0%} of the height"
    remedy = "give the intrinsics that belong to this image size"
    return [Finding("intrinsics", text, remedy, certain=off > _CENTER_CERTAIN)]


def _turning_speed(fits: Sequence[FlowFit], seconds: Sequence[float]) -> float:
    """How fast the camera turns in one direction, rad/s; what it turns to and fro cancels out."""
    turns = np.sum([cv2.Rodrigues(fit.rotation)[0][:, 0] for fit in fits], axis=0)
    return float(np.linalg.norm(turns) / sum(seconds))


def _start(segments: Sequence[Points], lens: Lens) -> Lens:
    """The lens with the focal length, of some, that fits best."""
    best, least = lens, np.inf
    for log_focal in _STARTS:
        numbers = np.zeros(number.COUNT)
        numbers[number.FOCAL] = log_focal
        tried = lens.with_numbers(numbers)
        error = float(np.mean([fit.error_px for fit in fit_flows(segments, tried)]))
        if error < 0.7 * least:
            best, least = tried, error
        if least < _GOOD_START_PX:
            break
    return best


def _choose(information: np.ndarray, weighted: np.ndarray) -> tuple[int, ...]:
    """Numbers, one after the other, of which each explains most of what is left."""
    everything = weighted @ np.linalg.solve(information + np.diag(1 / PRIOR**2), weighted)
    chosen: list[int] = []
    while len(chosen) < _MOST_NUMBERS:
        gains = {k: _gain(information, weighted, [*chosen, k]) for k in range(number.COUNT) if k not in chosen}
        best = max(gains, key=lambda k: gains[k])
        chosen.append(best)
        if gains[best] >= _EXPLAINED * everything:
            break
    return tuple(chosen)


def _gain(information: np.ndarray, weighted: np.ndarray, group: list[int]) -> float:
    inside = information[np.ix_(group, group)] + np.diag(1 / PRIOR[group] ** 2)
    return float(weighted[group] @ np.linalg.solve(inside, weighted[group]))


def _judge(fits: Sequence[FlowFit], chosen: tuple[int, ...], model_error: np.ndarray) -> tuple[np.ndarray, float]:
    """Values of the chosen numbers with all others at 0, and how many standard deviations they are from 0."""
    group = list(chosen)
    parts = []
    for fit in fits:
        inside = fit.information[np.ix_(group, group)] + 1e-9 * np.eye(len(group))
        parts.append((inside, np.linalg.solve(inside, (fit.information @ fit.numbers)[group])))
    total = np.sum([inside for inside, _ in parts], axis=0)
    mean = np.linalg.solve(total, np.sum([inside @ value for inside, value in parts], axis=0))
    spread = sum(float((value - mean) @ inside @ (value - mean)) for inside, value in parts)
    inflation = max(1.0, spread / max(len(group) * (len(parts) - 1), 1))
    covariance = inflation * np.linalg.inv(total) + np.diag(model_error[group] ** 2)
    values = np.zeros(number.COUNT)
    values[group] = mean
    sigmas = float(np.sqrt(mean @ np.linalg.solve(covariance, mean) / len(group)))
    return values, sigmas if len(parts) >= _LEAST_SEGMENTS else min(sigmas, DOUBTFUL_SIGMAS - 1)


def _words(estimate: LensEstimate) -> tuple[str, str]:
    """What is off, and what mends it."""
    values, main = estimate.values, estimate.chosen[0]
    if main == number.RADIAL:
        text = f"the images have lens distortion (k1 {values[main]:+.2f}), or were undistorted twice"
        return text, "undistort both images, or give the distortion coefficients"
    if main == number.RAY:
        text = "depth grows towards the image's border as if it were measured along the ray (a distance), not the axis"
        return text, "convert it: depth = distance / sqrt(1 + x^2 + y^2), x = (u - cx) / fx, y = (v - cy) / fy"
    if main == number.OFFSET:
        offset = 100 * values[main] * estimate.lens.median_m
        text = f"depth is off by a constant of about {offset:+.0f} cm, or is not proportional to depth at all"
        return text, "convert it to depth along the optical axis (disparity is inverse depth)"
    return _camera_words(estimate)


def _camera_words(estimate: LensEstimate) -> tuple[str, str]:
    camera, fitting = estimate.lens.camera, estimate.corrected
    focal = fitting.focal / (camera.fx, camera.fy)
    parts = []
    if abs(np.log(focal[0] / focal[1])) > _MATTERS[number.ASPECT]:
        parts.append(f"fx looks {_off(focal[0])} and fy {_off(focal[1])}")
    elif abs(np.log(focal[0])) > _MATTERS[number.FOCAL]:
        parts.append(f"the focal length looks {_off(float(np.sqrt(focal[0] * focal[1])))}")
    if max(abs(estimate.values[[number.SHIFT_X, number.SHIFT_Y]])) > _MATTERS[number.SHIFT_X]:
        parts.append("the principal point (cx, cy) looks shifted")
    said = " and ".join(parts) or "the intrinsics look off"
    return f"{said}, by how color moves against depth", _fitting_camera(camera, fitting)


def _fitting_camera(camera: Camera, fitting: Lens) -> str:
    scale = fitting.focal / (camera.fx, camera.fy)
    shift = (fitting.center - (camera.cx, camera.cy)) / (camera.width, camera.height)
    return (
        f"correct the intrinsics (about fx * {scale[0]:.2f}, fy * {scale[1]:.2f}, "
        f"cx {100 * shift[0]:+.0f} % of the width, cy {100 * shift[1]:+.0f} % of the height would fit)"
    )


def _off(factor: float) -> str:
    """`5 % too large` for a factor of 0.95 that would mend it."""
    percent = 100 * (1 / factor - 1)
    return f"{abs(percent):.0f} % too {'large' if percent > 0 else 'small'}" if abs(percent) >= 1 else "right"
