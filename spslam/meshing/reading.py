"""How many threads read frames for a mesh."""

from __future__ import annotations

from spslam.datasets.prefetch import usable_cores

# At least so many, for two cores, which compute beside; more than so many wait for Python, and have the thread wait for
# it that fuses: 1,000 frames on a GPU in 2.1 s by 4 threads, 2.9 by 2 and 3.1 by 8.
_LEAST, _MOST = 2, 4


def reading_threads() -> tuple[int, int]:
    """Number of threads that read, half the cores, and of frames that they read in advance."""
    threads = min(max(usable_cores() // 2, _LEAST), _MOST)
    return threads, 2 * threads
