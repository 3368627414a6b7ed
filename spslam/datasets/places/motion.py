"""How a camera is carried along a route: poses as a continuous function of time.

Amplitudes follow what is known of gait: 1.2 m/s and 1.8 steps/s with a vertical excursion of some 4 cm and a sway of 3
to 4 cm (Whittle, Gait Analysis), and hand tremor and drift of some mm below 2 Hz.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from spslam.datasets.places.route import Route
from spslam.geometry import pose_from


@dataclass(frozen=True)
class _Style:
    """Speed (m/s), shake relative to a steady hand, steps per second, fast turns, and stops."""

    speed: float
    shake: float = 1.0
    steps_hz: float = 0.0
    turns: bool = False
    stops: bool = False


_STYLES = {
    "handheld": _Style(0.55),
    "walking": _Style(1.15, shake=0.8, steps_hz=1.8),
    "fast_turns": _Style(0.45, shake=1.2, turns=True),
    "stop_and_go": _Style(0.5, shake=0.5, stops=True),
}
MOTIONS = tuple(_STYLES)
# Drift of the speed, as a share of it.
_SPEED_WAVE = 0.25
_BOB_M, _SWAY_M, _STEP_PITCH, _STEP_ROLL, _STEP_YAW = 0.02, 0.018, 0.008, 0.012, 0.012
# A fast turn: to a direction of up to `_TURN_REACH` beside the route's, at one of the rates (rad/s) at its middle.
_TURN_EVERY_S, _TURN_REACH, _TURN_RATES = 1.8, 1.15, (1.3, 2.9)
# Of a stop and the way to the next one.
_CYCLE_S, _STANDING_S = 7.0, 2.0
# Peak slope of the smooth step below.
_PEAK = 1.875


class Motion:
    """The camera's pose at any time, in seconds; the same arguments give the same poses.

    Args:
        route: the way.
        style: one of `MOTIONS`.
        seed: of shake, steps and turns.
        pace: factor on the style's speed and step length: slower at a desk than in a hall.

    Raises:
        ValueError: an unknown style.
    """

    def __init__(self, route: Route, style: str, seed: int, pace: float = 1.0) -> None:
        if style not in _STYLES:
            raise ValueError(f"Motion: style must be one of {', '.join(MOTIONS)}, got {style}")
        self._route, self._style, self._seed, self._pace = route, _STYLES[style], seed, pace
        generator = np.random.default_rng([seed, 21])
        self._frequency = generator.uniform(0.3, 1.6, (6, 5))
        self._phase = generator.uniform(0, 2 * np.pi, (6, 5))
        self._steps_hz = self._style.steps_hz * generator.uniform(0.93, 1.07)
        self._speed_wave = (generator.uniform(0.05, 0.12), generator.uniform(0, 2 * np.pi))

    @property
    def round_s(self) -> float:
        """Seconds of one round, on average."""
        return self._route.effort_m / self._speed

    @property
    def _speed(self) -> float:
        return self._style.speed * self._pace

    def poses(self, times: np.ndarray) -> np.ndarray:
        """Poses T_world_camera, float64 [N, 4, 4], at times [N] in seconds."""
        times = np.asarray(times, dtype=np.float64)
        position, yaw, pitch = self._route.at(self.effort(times))
        moved = self._shake(times) + self._steps(times)
        moved[:, 3] += self._turns(times)
        forward, left = np.stack((np.cos(yaw), np.sin(yaw)), 1), np.stack((-np.sin(yaw), np.cos(yaw)), 1)
        position[:, :2] += moved[:, :1] * forward + moved[:, 1:2] * left
        position[:, 2] += moved[:, 2]
        return _looking(position, yaw + moved[:, 3], pitch + moved[:, 4], moved[:, 5])

    def pose(self, time: float) -> np.ndarray:
        """The pose [4, 4] at one time in seconds."""
        return self.poses(np.array([time]))[0]

    def way(self, effort: np.ndarray) -> np.ndarray:
        """Positions [N, 3] of the route without shake and steps, m, at efforts [N]."""
        return self._route.at(effort)[0]

    def effort(self, times: np.ndarray) -> np.ndarray:
        """How far along the route the camera is at times [N] in seconds, in the route's parameter."""
        if self._style.stops:
            cycle = np.floor(times / _CYCLE_S)
            share = np.clip((times - cycle * _CYCLE_S) / (_CYCLE_S - _STANDING_S), 0, 1)
            return self._speed * _CYCLE_S * (cycle + _smooth_step(share))
        frequency, phase = self._speed_wave
        omega = 2 * np.pi * frequency
        return self._speed * (times + _SPEED_WAVE / omega * (np.sin(omega * times + phase) - np.sin(phase)))

    def _shake(self, times: np.ndarray) -> np.ndarray:
        """Offsets [N, 6]: forward, left, up in m, then yaw, pitch and roll in radians."""
        amplitude = self._style.shake * np.array([0.004] * 3 + [0.006] * 3)[:, None] / np.maximum(self._frequency, 0.5)
        amplitude = amplitude * np.array([min(self._pace, 1.0)] * 3 + [1.0] * 3)[:, None]
        return np.sum(amplitude * np.sin(2 * np.pi * self._frequency * times[:, None, None] + self._phase), axis=2)

    def _steps(self, times: np.ndarray) -> np.ndarray:
        if self._steps_hz == 0:
            return np.zeros((len(times), 6))
        step = 2 * np.pi * self._steps_hz * times
        half = step / 2
        bob = _BOB_M * np.cos(step) + 0.25 * _BOB_M * np.cos(2 * step + 0.6)
        forward = 0.3 * _BOB_M * np.sin(step)
        return np.stack(
            (
                forward,
                _SWAY_M * np.sin(half),
                bob,
                _STEP_YAW * np.sin(half + 0.4),
                _STEP_PITCH * np.sin(step + 0.8),
                _STEP_ROLL * np.sin(half + 1.1),
            ),
            axis=1,
        )

    def _turns(self, times: np.ndarray) -> np.ndarray:
        """Yaw [N] beside the route's: from one direction to the next within a fraction of each interval."""
        if not self._style.turns:
            return np.zeros(len(times))
        interval = np.floor(times / _TURN_EVERY_S).astype(int)
        numbers, where = np.unique(interval, return_inverse=True)
        turns = np.array([self._turn(int(number)) for number in numbers]).reshape(-1, 3)[where]
        before, after, seconds = turns.T
        since = times - interval * _TURN_EVERY_S
        return before + (after - before) * _smooth_step(np.clip(since / seconds, 0, 1))

    def _turn(self, interval: int) -> tuple[float, float, float]:
        before, after = self._direction(interval), self._direction(interval + 1)
        rate = np.random.default_rng([self._seed, 23, interval & 0xFFFFFFFF]).uniform(*_TURN_RATES)
        return before, after, float(np.clip(_PEAK * abs(after - before) / rate, 0.3, _TURN_EVERY_S))

    def _direction(self, interval: int) -> float:
        side = 1 if interval % 2 else -1
        return side * np.random.default_rng([self._seed, 22, interval & 0xFFFFFFFF]).uniform(0.1, 1) * _TURN_REACH


def _smooth_step(share: np.ndarray) -> np.ndarray:
    """0 to 1 with zero speed and acceleration at both ends (quintic)."""
    return share**3 * (10 - 15 * share + 6 * share**2)


def _looking(eye: np.ndarray, yaw: np.ndarray, pitch: np.ndarray, roll: np.ndarray) -> np.ndarray:
    c, s = np.cos(yaw), np.sin(yaw)
    forward = np.stack((np.cos(pitch) * c, np.cos(pitch) * s, np.sin(pitch)), axis=1)
    level_right = np.stack((s, -c, np.zeros_like(s)), axis=1)
    level_down = np.cross(forward, level_right)
    right = np.cos(roll)[:, None] * level_right + np.sin(roll)[:, None] * level_down
    return pose_from(np.stack((right, np.cross(forward, right), forward), axis=2), eye)
