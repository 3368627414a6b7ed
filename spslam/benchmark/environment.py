"""What a result depends on besides its options: machine, versions, commit."""

from __future__ import annotations

import platform
import subprocess
from pathlib import Path
from typing import Any

import torch

import spslam
from spslam import ops
from spslam.run.provenance import device_name


def describe_environment(device: torch.device) -> dict[str, Any]:
    """Device, versions, kernels, threads and commit, for the record of a run."""
    return {
        "device": device.type,
        "device_name": device_name(device),
        "cpu_kernels": ops.CPU_ISA,
        "kernel_threads": ops.get_num_threads(),
        "spslam": spslam.__version__,
        "torch": torch.__version__,
        "python": platform.python_version(),
        "commit": commit(),
    }


def commit() -> str | None:
    """The commit of the running code, with a plus if files have changed since; None outside a repository."""
    root = Path(spslam.__file__).parent.parent
    if not (root / ".git").exists():  # an installed package; a repository further up is another project's
        return None
    command = ["git", "describe", "--always", "--dirty=+", "--exclude=*"]
    try:
        return subprocess.run(command, cwd=root, capture_output=True, text=True, check=True).stdout.strip() or None
    except (OSError, subprocess.CalledProcessError):
        return None
