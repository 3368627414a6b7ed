"""Threads for what the keyframe graph has the host do beside a GPU: image features, and pixels drawn of keyframes."""

from __future__ import annotations

import os
from concurrent.futures import ThreadPoolExecutor

import torch

MOST = 8


def host_threads(device: torch.device) -> ThreadPoolExecutor | None:
    """A pool of half the cores, 8 at most; None where the kernels run on the CPU, as tracking needs the cores there."""
    if device.type != "cuda":
        return None
    threads = max(min(MOST, (os.cpu_count() or 1) // 2), 1)
    return ThreadPoolExecutor(threads, thread_name_prefix="spslam-keyframes")
