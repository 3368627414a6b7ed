"""``spslam doctor``: versions, kernels and devices, and why CUDA is off if it is."""

from __future__ import annotations

import argparse
import platform
from pathlib import Path
from typing import Any

import spslam
from spslam.errors import DeviceError


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """No option."""


def execute(args: argparse.Namespace) -> None:
    _row("spslam", f"{spslam.__version__} in {Path(spslam.__file__).parent}")
    _row("python", f"{platform.python_version()}, {platform.platform()}")
    import torch

    _row("torch", f"{torch.__version__}, " + (f"CUDA {torch.version.cuda}" if torch.version.cuda else "without CUDA"))
    _row("libraries", ", ".join(sorted(path.name for path in Path(spslam.__file__).parent.glob("_ops_*.so"))) or "none")
    try:
        from spslam import ops
    except ImportError as error:
        raise DeviceError(str(error).removeprefix("spslam: ")) from error
    except RuntimeError as error:
        raise DeviceError(f"the kernel libraries don't fit this spslam, build them again: {error}") from error
    _row("CPU kernels", f"{ops.CPU_ISA}, {torch.get_num_threads()} threads; {_try(torch.device('cpu'))}")
    if ops.CUDA_OFF_REASON:
        _row("CUDA kernels", f"off: {ops.CUDA_OFF_REASON}")
    else:
        _row("CUDA kernels", _try(torch.device("cuda")))
    for index in range(torch.cuda.device_count()):
        gpu = torch.cuda.get_device_properties(index)
        _row(f"GPU {index}", f"{gpu.name}, {gpu.total_memory / 2**30:.0f} GiB, compute {gpu.major}.{gpu.minor}")


def _try(device: Any) -> str:
    """Runs one small kernel, whose result is known, on a device."""
    from spslam import ops

    try:
        drawn = ops.philox_uniform(0, ops.Stream.EVALUATION, 0, 0, 1000, device=device)
        expected = ops.philox_uniform(0, ops.Stream.EVALUATION, 0, 0, 1000, device="cpu")
    except Exception as error:
        return f"fail: {' '.join(str(error).split())[:200]}"
    return "working" if drawn.cpu().equal(expected) else "fail: wrong numbers"


def _row(name: str, text: str) -> None:
    print(f"{name:<14}{text}")
