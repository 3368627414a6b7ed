"""What a result depends on beside its settings: machine, versions, commit."""

from __future__ import annotations

import platform
import subprocess
from pathlib import Path
from typing import Any

import torch

import spslam
from spslam import ops


def describe_environment(device: torch.device) -> dict[str, Any]:
    """Device, versions, kernels, threads and commit, for the record of a run."""
    return {
        "device": device.type,
        "device_name": torch.cuda.get_device_name(device) if device.type == "cuda" else processor_name(),
        "cpu_kernels": ops.CPU_ISA,
        "kernel_threads": ops.get_num_threads(),
        "spslam": spslam.__version__,
        "torch": torch.__version__,
        "python": platform.python_version(),
        "commit": commit(),
    }


def commit() -> str | None:
    """The commit that runs, with a plus where files differ from it; None outside a repository."""
    root = Path(spslam.__file__).parent.parent
    if not (root / ".git").exists():  # installed: a repository further up is another project's
        return None
    command = ["git", "describe", "--always", "--dirty=+", "--exclude=*"]
    try:
        return subprocess.run(command, cwd=root, capture_output=True, text=True, check=True).stdout.strip() or None
    except (OSError, subprocess.CalledProcessError):
        return None


def processor_name() -> str:
    """The processor's model name where the system tells, else its architecture."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return platform.processor() or platform.machine()
    names = [line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.machine()
