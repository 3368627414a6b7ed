"""What a result was made with: versions, seed and device."""

import platform
from pathlib import Path
from typing import Any

import torch

from spslam import __version__
from spslam.config import Config


def provenance(config: Config, device: torch.device) -> dict[str, Any]:
    """Version, torch version, seed and device, for the files of a run."""
    return {
        "version": __version__,
        "torch": torch.__version__,
        "seed": config.seed,
        "device": str(device),
        "device_name": device_name(device),
    }


def device_name(device: torch.device) -> str:
    """The model name of the GPU, or of the processor where the system tells it, else the processor's architecture."""
    return torch.cuda.get_device_name(device) if device.type == "cuda" else _processor_name()


def _processor_name() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        lines = []
    names = (line.split(":", 1)[1].strip() for line in lines if line.startswith("model name"))
    return next(names, "") or platform.processor() or platform.machine()
