"""Plots of a training; needs matplotlib."""

from __future__ import annotations

import json
from pathlib import Path

from spslam.errors import SpslamError
from spslam.io import atomic_write


def require_matplotlib() -> None:
    """Raises SpslamError with the extra to install if matplotlib is missing."""
    try:
        import matplotlib  # noqa: F401
    except ImportError as error:
        raise SpslamError("plots need matplotlib: pip install 'spslam[eval]'") from error


def plot_training(log: Path, image: Path) -> None:
    """Plots the error over the steps, on training and on held-out solids.

    Args:
        log: log file of `spslam.prior.pretrain.pretrain`.
        image: image file to write.

    Raises:
        SpslamError: matplotlib is missing.
        OutputError: the image cannot be written.
    """
    require_matplotlib()
    from matplotlib.figure import Figure

    entries = [json.loads(line) for line in log.read_text().splitlines()]
    training = [entry for entry in entries if "error_mm" in entry]
    held_out = [entry for entry in entries if "validation" in entry]
    figure = Figure(figsize=(7, 4), layout="constrained")
    axes = figure.add_subplot()
    axes.plot([entry["step"] for entry in training], [entry["error_mm"] for entry in training], label="training, mean")
    for name, label in (("near_mae_mm", "held out, within a voxel"), ("zero_crossing_mm", "held out, zero crossing")):
        values = [entry["validation"]["mean"][name] for entry in held_out]
        axes.plot([entry["step"] for entry in held_out], values, marker=".", label=label)
    axes.set(xlabel="step", ylabel="error, mm at 4 cm voxels", yscale="log")
    axes.grid(True, which="both", alpha=0.3)
    axes.legend()
    atomic_write(image, lambda path: figure.savefig(path, dpi=120))
