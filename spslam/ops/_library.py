"""Loads the compiled op libraries: one for the instruction set of this CPU, and the CUDA one if torch has CUDA.

`SPSLAM_CPU_ISA` (baseline, avx2 or avx512) overrides the choice, for tests and bug reports.
"""

import os
import pathlib

import torch

from spslam.ops._checks import check
from spslam.ops._public import public_op

_FOLDER = pathlib.Path(__file__).resolve().parent.parent
_LIBRARY_OF_ISA = {"avx512": "_ops_cpu_avx512.so", "avx2": "_ops_cpu_avx2.so", "baseline": "_ops_cpu.so"}
_MAX_THREADS = 4096
_ISAS_OF_CAPABILITY = {"AVX512": ("avx512", "avx2", "baseline"), "AVX2": ("avx2", "baseline")}


def _candidates() -> tuple[str, ...]:
    chosen = os.environ.get("SPSLAM_CPU_ISA")
    if chosen:
        if chosen not in _LIBRARY_OF_ISA:
            raise ImportError(f"SPSLAM_CPU_ISA must be one of {', '.join(_LIBRARY_OF_ISA)}, got {chosen}")
        return (chosen,)
    return _ISAS_OF_CAPABILITY.get(torch.backends.cpu.get_cpu_capability(), ("baseline",))


def _load_cpu() -> str:
    for isa in _candidates():
        path = _FOLDER / _LIBRARY_OF_ISA[isa]
        if path.exists():
            try:
                torch.ops.load_library(str(path))
            except OSError as error:
                raise ImportError(f"spslam: torch must be 2.11 or later, got {torch.__version__}: {error}") from error
            return isa
    raise ImportError(
        f"spslam: no compiled kernels for {' or '.join(_candidates())} in {_FOLDER}; install the wheel, "
        "or build in place with `make dev`"
    )


def _load_cuda() -> str | None:
    """Returns why CUDA is off, or None where it is on."""
    path = _FOLDER / "_ops_cuda.so"
    if not torch.version.cuda:
        return "the installed torch is a CPU build"
    if not path.exists():
        return "spslam was built without CUDA; install it again with SPSLAM_CUDA=ON in the environment"
    try:
        torch.ops.load_library(str(path))
    except OSError as error:
        return f"{path.name} does not load: {error}"
    if not torch.cuda.is_available():
        return "torch finds no CUDA device"
    return None


CPU_ISA: str = _load_cpu()
CUDA_OFF_REASON: str | None = _load_cuda()


@public_op()
def set_num_threads(count: int) -> None:
    """Sets the number of threads of the CPU kernels, including the calling one. Results do not depend on it.

    The initial value is torch's number of threads. Must not be called while another thread runs a kernel.

    Args:
        count: 1 to 4096. Where the system gives fewer, kernels run on those there are.

    Raises:
        TypeError: `count` is no integer.
        ValueError: `count` out of range.

    Example:
        >>> set_num_threads(2)
        >>> get_num_threads()
        2
    """
    check(count >= 1, "set_num_threads", "count", "be at least 1", count)
    check(count <= _MAX_THREADS, "set_num_threads", "count", f"be at most {_MAX_THREADS}", count)
    torch.ops.spslam.set_num_threads(count)


def get_num_threads() -> int:
    """Number of threads of the CPU kernels.

    Example:
        >>> get_num_threads() >= 1
        True
    """
    return torch.ops.spslam.get_num_threads()


set_num_threads(min(torch.get_num_threads(), _MAX_THREADS))
