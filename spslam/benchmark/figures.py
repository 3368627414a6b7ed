"""The figures of a run by name: title, unit and digits in tables."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass


@dataclass(frozen=True)
class Figure:
    """How a figure is printed: title in a table, unit, digits after the decimal point."""

    title: str
    unit: str
    digits: int

    @property
    def label(self) -> str:
        """Title with its unit."""
        return f"{self.title} {self.unit}".strip()


FIGURES = {
    "frames": Figure("frames", "", 0),
    "ate_rmse_cm": Figure("ATE RMSE", "cm", 2),
    "ate_live_cm": Figure("ATE live", "cm", 2),
    "ate_median_cm": Figure("ATE median", "cm", 2),
    "ate_max_cm": Figure("ATE max", "cm", 2),
    "rpe_cm": Figure("RPE", "cm", 2),
    "rpe_deg": Figure("RPE", "deg", 2),
    "lost_frames": Figure("lost", "", 0),
    "fps": Figure("frames/s", "", 1),
    "decode_ms": Figure("decode", "ms", 1),
    "encode_ms": Figure("encode", "ms", 1),
    "tracking_ms_per_iteration": Figure("tracking", "ms/it", 2),
    "tracking_iterations": Figure("track. it", "", 0),
    "tracking_fps": Figure("tracking frames/s", "", 1),
    "mapping_ms_per_iteration": Figure("mapping", "ms/it", 2),
    "mapping_iterations": Figure("map. it", "", 0),
    "model_mb": Figure("model", "MB", 1),
    "voxels": Figure("voxels", "", 0),
    "peak_gpu_mb": Figure("GPU", "MB", 0),
    "peak_gpu_gb": Figure("GPU", "GB", 2),
    "peak_rss_mb": Figure("memory", "MB", 0),
    "accuracy_cm": Figure("accuracy", "cm", 2),
    "completeness_cm": Figure("completeness", "cm", 2),
    "accuracy_5cm": Figure("accuracy", "% at 5 cm", 1),
    "completeness_5cm": Figure("completeness", "% at 5 cm", 1),
    "accuracy_1cm": Figure("accuracy", "% at 1 cm", 1),
    "completeness_1cm": Figure("completeness", "% at 1 cm", 1),
    "f1_5cm": Figure("F1", "% at 5 cm", 1),
    "f1_1cm": Figure("F1", "% at 1 cm", 1),
    "depth_l1_cm": Figure("depth L1", "cm", 2),
    "psnr_db": Figure("PSNR", "dB", 1),
    "ssim": Figure("SSIM", "", 3),
}


def figure(name: str) -> Figure:
    """How a figure is printed; one without an entry has its name as title."""
    return FIGURES.get(name, Figure(name, "", 2))


@dataclass(frozen=True)
class Statistic:
    """A figure over the runs of one cell: mean, sample standard deviation (0 for one run), minimum, maximum, runs."""

    mean: float
    deviation: float
    low: float
    high: float
    runs: int

    @classmethod
    def of(cls, values: Sequence[float]) -> Statistic:
        """The statistic of at least one value."""
        mean = math.fsum(values) / len(values)
        squares = math.fsum((value - mean) ** 2 for value in values)
        return cls(mean, math.sqrt(squares / max(len(values) - 1, 1)), min(values), max(values), len(values))

    def text(self, digits: int) -> str:
        """Mean, and standard deviation where runs differ: `2.30 ± 0.02`."""
        spread = f" ± {self.deviation:.{digits}f}" if self.runs > 1 and self.high > self.low else ""
        return f"{self.mean:.{digits}f}{spread}"
