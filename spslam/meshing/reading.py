"""How many threads read frames for a mesh."""

from __future__ import annotations

from spslam.datasets.prefetch import usable_cores

# At least so many, for two cores, which compute beside; more than so many wait for Python's interpreter: 996 frames
# beside a GPU with 16 cores in 2.1 s by 4 threads, 1.7 by 6, 1.6 by 8 and 2.0 by 12.
_LEAST, _MOST = 2, 6


def reading_threads(readers: int = 0) -> tuple[int, int]:
    """Number of threads that read, half the cores, and of frames that they read in advance.

    Args:
        readers: of the dataset: processes that read it, for each of which a thread only waits.
    """
    threads = readers or min(max(usable_cores() // 2, _LEAST), _MOST)
    return threads, 2 * threads
