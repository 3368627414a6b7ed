"""Threads for what the host does beside a GPU: poses by image features; features and pixels of keyframes."""

from __future__ import annotations

import contextlib
import functools
import os
from concurrent.futures import ThreadPoolExecutor

import torch

MOST = 8
NICENESS = 10  # in a live run, above the process's: tracking comes first where cores are scarce


def host_threads(device: torch.device) -> ThreadPoolExecutor | None:
    """A pool of half the cores, 8 at most; None where the kernels run on the CPU, as tracking needs the cores there."""
    if device.type != "cuda":
        return None
    return ThreadPoolExecutor(host_thread_count(), thread_name_prefix="spslam-host")


@functools.cache
def shared_host_threads(device: torch.device) -> ThreadPoolExecutor | None:
    """`host_threads` that all maps of the process share, as for what is short; they end with it."""
    return host_threads(device)


def host_thread_count() -> int:
    """Half the cores, 8 at most: tracking and reading need the others."""
    return max(min(MOST, (os.cpu_count() or 1) // 2), 1)


def give_way(number: int) -> None:
    """Lets a thread or a process, by its number, wait for this process's threads, where the system can."""
    with contextlib.suppress(OSError, AttributeError):
        os.setpriority(os.PRIO_PROCESS, number, os.getpriority(os.PRIO_PROCESS, os.getpid()) + NICENESS)
