"""The curves of a run: numbers over frames, reduced to what a chart can show."""

from __future__ import annotations

import warnings
from dataclasses import dataclass

import numpy as np

from spslam.viewer.colors import hexadecimal
from spslam.viewer.model import RunModel

MAX_POINTS = 400


@dataclass(frozen=True)
class Curve:
    """A curve.

    Attributes:
        title: with the unit.
        column: of the model.
        color: `#rrggbb`.
        scale: by which the values are multiplied.
    """

    title: str
    column: str
    color: str
    scale: float = 1.0

    def points(self, model: RunModel) -> tuple[np.ndarray, np.ndarray]:
        """Frame numbers and values, each float64 [n <= MAX_POINTS]; of many frames, the largest value of several."""
        frames, values = self._reduced(self.scale * model.column(self.column))
        known = np.isfinite(values)
        return frames[known], values[known]

    @staticmethod
    def _reduced(values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        if len(values) <= MAX_POINTS:
            return np.arange(len(values), dtype=np.float64), values
        per_point = -(-len(values) // MAX_POINTS)
        padded = np.full(per_point * -(-len(values) // per_point), np.nan)
        padded[: len(values)] = values
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", RuntimeWarning)  # several frames without any value
            largest = np.nanmax(padded.reshape(-1, per_point), axis=1)
        return np.arange(len(largest), dtype=np.float64) * per_point, largest


CURVES = (
    Curve("Frames per second", "fps", hexadecimal((38, 108, 196))),
    Curve("Residual, cm", "residual_cm", hexadecimal((120, 80, 170))),
    Curve("Error probability", "error_probability", hexadecimal((206, 32, 41))),
    Curve("Memory of the run, MB", "memory_mb", hexadecimal((0, 120, 90))),
    Curve("Map, thousand vertices", "voxels", hexadecimal((150, 100, 0)), 1e-3),
)


def known_curves(model: RunModel) -> list[Curve]:
    """Those that have a value."""
    return [curve for curve in CURVES if bool(np.isfinite(model.column(curve.column)).any())]
