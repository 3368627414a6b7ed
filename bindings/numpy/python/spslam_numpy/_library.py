"""Loads the compiled kernels of the best instruction set that this processor has."""

import importlib
import os
from types import ModuleType

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


CPU_ISA, kernels = _load()
