"""The closed way of a camera through a place: where it passes and where it looks, as smooth functions of one number."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

_STEP_M = 0.02
_KNOT_M = 0.08
# Who turns walks slower: this much longer per radian.
_TURN_M_PER_RAD = 0.6


@dataclass(frozen=True)
class Gaze:
    """Where the camera looks on its way.

    Attributes:
        target: world point [3] that it looks at; None looks along the way.
        ahead_m: along the way, it looks at the point so far ahead.
        pitch: radians, upward; 0 is level. Added to the direction of `target`.
        glance: radians to either side, with wave length `glance_m`.
        glance_m: m.
        side: radians to the left, always.
    """

    target: tuple[float, float, float] | None = None
    ahead_m: float = 1.2
    pitch: float = -0.15
    glance: float = 0.4
    glance_m: float = 7.0
    side: float = 0.0


class Route:
    """A closed curve through way points with rounded corners, and a direction to look in.

    It is parametrized by effort: length in meters, plus more where the direction turns. Both are periodic.

    Args:
        points: [N, 3], m, of the camera; the last is joined to the first.
        gaze: where it looks.
        rounding_m: corners are rounded over this length.
        phase: 0 to 1, of the glances.

    Attributes:
        length_m: of one round.
        effort_m: the parameter's period.
    """

    def __init__(self, points: np.ndarray, gaze: Gaze, rounding_m: float = 0.8, phase: float = 0.0) -> None:
        curve = _resampled(_rounded(_resampled(np.asarray(points, dtype=np.float64), _STEP_M), rounding_m), _STEP_M)
        steps = np.linalg.norm(np.roll(curve, -1, axis=0) - curve, axis=1)
        self.length_m = float(steps.sum())
        yaw, pitch = _directions(curve, steps.mean(), gaze, phase)
        turn = np.abs(np.diff(yaw, append=yaw[:1] + _winding(yaw)))
        smooth_turn = _smoothed(turn[:, None], round(0.5 / _STEP_M))[:, 0]
        effort = np.concatenate(([0], np.cumsum(steps + _TURN_M_PER_RAD * smooth_turn)))
        self.effort_m = float(effort[-1])
        every = max(round(_KNOT_M / _STEP_M), 1)
        knots = np.append(np.arange(0, len(curve), every), len(curve))
        self._winding = _winding(yaw)
        flat_yaw = yaw - self._winding * effort[:-1] / self.effort_m
        values = np.concatenate((curve, flat_yaw[:, None], pitch[:, None]), axis=1)
        from scipy.interpolate import CubicSpline

        self._spline = CubicSpline(effort[knots], values[knots % len(curve)], bc_type="periodic")

    def at(self, effort: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Positions [N, 3], yaw [N] (unwrapped) and pitch [N], radians, at efforts [N]; any number of rounds."""
        effort = np.asarray(effort, dtype=np.float64)
        values = self._spline(np.mod(effort, self.effort_m))
        return values[:, :3], values[:, 3] + self._winding * effort / self.effort_m, values[:, 4]


def _winding(yaw: np.ndarray) -> float:
    """How far the unwrapped yaw turns in a round: a multiple of 2 pi."""
    closing = np.mod(yaw[0] - yaw[-1] + np.pi, 2 * np.pi) - np.pi
    return float(2 * np.pi * np.round((yaw[-1] + closing - yaw[0]) / (2 * np.pi)))


def _directions(curve: np.ndarray, step_m: float, gaze: Gaze, phase: float) -> tuple[np.ndarray, np.ndarray]:
    count = len(curve)
    if gaze.target is None:
        towards = np.roll(curve, -max(round(gaze.ahead_m / step_m), 1), axis=0) - curve
        climb = np.zeros(count)
    else:
        towards = np.asarray(gaze.target) - curve
        climb = np.arctan2(towards[:, 2], np.hypot(towards[:, 0], towards[:, 1]))
    yaw = np.unwrap(np.arctan2(towards[:, 1], towards[:, 0]))
    winding = _winding(yaw)
    ramp = winding * np.arange(count) / count
    window = round(0.6 / step_m)
    yaw = _smoothed((yaw - ramp)[:, None], window)[:, 0] + ramp
    waves = max(round(count * step_m / gaze.glance_m), 1)
    turn = 2 * np.pi * (np.arange(count) / count * waves + phase)
    slope = _smoothed(towards[:, 2:], window)[:, 0] / max(gaze.ahead_m, 0.5) if gaze.target is None else 0.0
    pitch = gaze.pitch + climb + 0.5 * np.arctan(slope) + 0.25 * gaze.glance * np.sin(0.5 * np.pi + turn)
    return yaw + gaze.side + gaze.glance * np.sin(turn), pitch


def _resampled(points: np.ndarray, step_m: float) -> np.ndarray:
    closed = np.concatenate((points, points[:1]))
    length = np.concatenate(([0], np.cumsum(np.linalg.norm(np.diff(closed, axis=0), axis=1))))
    count = max(round(length[-1] / step_m), 16)
    at = np.arange(count) * (length[-1] / count)
    return np.stack([np.interp(at, length, closed[:, axis]) for axis in range(points.shape[1])], axis=1)


def _rounded(curve: np.ndarray, rounding_m: float) -> np.ndarray:
    half = max(round(rounding_m / _STEP_M / 2), 1)
    return _smoothed(_smoothed(curve, half), half)


def _smoothed(values: np.ndarray, half: int) -> np.ndarray:
    """Periodic mean [N, C] with a Hann window of 2 * half + 1 samples."""
    half = min(half, (len(values) - 1) // 2)
    window = np.hanning(2 * half + 3)[1:-1]
    padded = np.concatenate((values[-half:], values, values[:half])) if half else values
    columns = [np.convolve(padded[:, c], window / window.sum(), mode="valid") for c in range(values.shape[1])]
    return np.stack(columns, axis=1)
