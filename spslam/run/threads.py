"""How many threads libraries and kernels use during a run."""

import contextlib
from collections.abc import Iterator

import cv2
import torch

from spslam import ops


@contextlib.contextmanager
def library_threads_limited() -> Iterator[None]:
    """Restricts torch and OpenCV to one thread each: theirs would compete with the kernels and the reading threads."""
    threads, decoder_threads = torch.get_num_threads(), cv2.getNumThreads()
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)
        cv2.setNumThreads(decoder_threads)


@contextlib.contextmanager
def kernel_threads_limited(device: torch.device, most: int = 1) -> Iterator[None]:
    """On CUDA, restricts the CPU kernels to so many threads: they only sample frames, each reading thread one of its
    own, and compare image features; a live run has several for a frame."""
    threads = ops.get_num_threads()
    if device.type == "cuda":
        ops.set_num_threads(min(threads, most))
    try:
        yield
    finally:
        ops.set_num_threads(threads)
