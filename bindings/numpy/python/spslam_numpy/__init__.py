"""spslam's CPU kernels for NumPy arrays, without torch.

The functions are those of `spslam.ops` that need no gradient tape, with the same names, arguments and results, to the
bit; differentiable ones have their derivative beside them as `<name>_backward`. Contiguous arrays are not copied, and
Python's lock is released while a kernel runs. Errors: TypeError for another dtype, ValueError for another shape.

    >>> import numpy as np
    >>> keys, values = new_voxel_hash(16)
    >>> voxel_hash_insert(keys, values, np.array([[2, 0, 0], [1, 0, 0]], np.int32), 0).tolist()
    [[1, 0, 0], [2, 0, 0]]

`SPSLAM_CPU_ISA` (baseline, avx2 or avx512) overrides the choice of the instruction set.
"""

import importlib
import os
from types import ModuleType

__version__ = "0.1.0"

_AVX2 = {"avx2", "bmi1", "bmi2", "f16c", "fma", "abm", "movbe"}
# What a processor must have for each build, best first; baseline runs everywhere.
_FEATURES = {
    "avx512": _AVX2 | {"avx512f", "avx512bw", "avx512cd", "avx512dq", "avx512vl"},
    "avx2": _AVX2,
    "baseline": set(),
}


def _processor_features() -> set[str]:
    try:
        with open("/proc/cpuinfo", encoding="ascii", errors="replace") as file:
            line = next((line for line in file if line.startswith("flags")), "")
    except OSError:
        return set()
    return set(line.split())


def _load() -> tuple[str, ModuleType]:
    chosen = os.environ.get("SPSLAM_CPU_ISA")
    if chosen and chosen not in _FEATURES:
        raise ImportError(f"SPSLAM_CPU_ISA must be one of {', '.join(_FEATURES)}, got {chosen}")
    present = _processor_features()
    candidates = [chosen] if chosen else [isa for isa, needed in _FEATURES.items() if needed <= present]
    for isa in candidates:
        try:
            return isa, importlib.import_module(f"spslam_numpy._kernels_{isa}")
        except ModuleNotFoundError:
            continue
    raise ImportError(f"spslam_numpy: no compiled kernels for {' or '.join(candidates)}")


CPU_ISA, _kernels = _load()
__all__ = ["CPU_ISA", *sorted(name for name in vars(_kernels) if not name.startswith("_"))]
globals().update({name: getattr(_kernels, name) for name in __all__[1:]})
