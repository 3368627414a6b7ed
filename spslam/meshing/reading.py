"""How many threads read frames for a mesh."""

from __future__ import annotations

import os

# At least so many, for two cores, which compute beside; more than so many wait for memory and for Python.
_LEAST, _MOST = 2, 8


def reading_threads() -> tuple[int, int]:
    """Number of threads that read, half the cores, and of frames that they read in advance."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    threads = min(max(cores // 2, _LEAST), _MOST)
    return threads, 2 * threads
