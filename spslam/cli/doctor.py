"""`spslam doctor`: shows versions, kernels and devices, and the reason if CUDA is off."""

from __future__ import annotations

import argparse
import platform
import re
from pathlib import Path
from typing import Any

import spslam
from spslam.errors import DeviceError


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """This command has no options."""


def execute(args: argparse.Namespace) -> None:
    _row("spslam", f"{spslam.__version__} in {Path(spslam.__file__).parent}")
    _row("python", f"{platform.python_version()}, {platform.platform()}")
    import torch

    _row("torch", f"{torch.__version__}, " + (f"CUDA {torch.version.cuda}" if torch.version.cuda else "without CUDA"))
    _row("libraries", ", ".join(sorted(path.name for path in Path(spslam.__file__).parent.glob("_*.so"))) or "none")
    try:
        from spslam import ops
    except ImportError as error:
        raise DeviceError(str(error).removeprefix("spslam: ")) from error
    except RuntimeError as error:
        raise DeviceError(f"the kernel libraries do not match this spslam, build them again: {error}") from error
    _row("CPU kernels", f"{ops.CPU_ISA}, {torch.get_num_threads()} threads; {_test_kernel(torch.device('cpu'))}")
    if ops.CUDA_OFF_REASON:
        _row("CUDA kernels", f"off: {ops.CUDA_OFF_REASON}")
    else:
        _row("CUDA kernels", _test_kernel(torch.device("cuda")))
    archs = cuda_archs(Path(spslam.__file__).parent / "_ops_cuda.so")
    if archs:
        _row("built for", ", ".join(archs))
    for index in range(torch.cuda.device_count()):
        gpu = torch.cuda.get_device_properties(index)
        _row(f"GPU {index}", f"{gpu.name}, {gpu.total_memory / 2**30:.0f} GiB, compute {gpu.major}.{gpu.minor}")


def cuda_archs(library: Path) -> list[str]:
    """GPU architectures in a CUDA library, such as `sm_90` and `PTX 120`, without loading it; [] if there is none."""
    try:
        found = re.search(rb"spslam-cuda-archs=([\w -]+)", library.read_bytes())
    except OSError:
        return []
    names = []
    for arch in found[1].decode().split() if found else []:
        number, _, kind = arch.partition("-")
        # In CMake's notation a number without -real or -virtual means both.
        names += [f"sm_{number}"] * (kind != "virtual") + [f"PTX {number}"] * (kind != "real")
    return names


def _test_kernel(device: Any) -> str:
    """Runs one small kernel on a device and compares its result with that of the CPU."""
    from spslam import ops

    try:
        drawn = ops.philox_uniform(0, ops.RandomStream.EVALUATION, 0, 0, 1000, device=device)
        expected = ops.philox_uniform(0, ops.RandomStream.EVALUATION, 0, 0, 1000, device="cpu")
    except Exception as error:
        return f"fail: {' '.join(str(error).split())[:200]}"
    return "working" if drawn.cpu().equal(expected) else "fail: wrong result"


def _row(name: str, text: str) -> None:
    print(f"{name:<14}{text}")
