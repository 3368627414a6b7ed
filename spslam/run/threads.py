"""How many threads libraries and kernels use during a run, and how long one may keep the others from Python."""

import contextlib
import sys
from collections.abc import Iterator

import cv2
import torch

from spslam import ops

# s, for which a thread may hold Python's interpreter while another waits for it. Python's own 5 ms are as long as a
# frame on a GPU: the loop would wait for them when it comes back from a kernel while the keyframe graph's thread runs.
INTERPRETER_SHARE_S = 1e-4


@contextlib.contextmanager
def interpreter_shared() -> Iterator[None]:
    """Has threads hand Python's interpreter to one another early, so that none keeps the frame loop waiting."""
    interval_s = sys.getswitchinterval()
    sys.setswitchinterval(min(interval_s, INTERPRETER_SHARE_S))
    try:
        yield
    finally:
        sys.setswitchinterval(interval_s)


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
def kernel_threads_limited(device: torch.device) -> Iterator[None]:
    """On CUDA, restricts the CPU kernels to one thread: they only sample frames, one on each reading thread."""
    threads = ops.get_num_threads()
    if device.type == "cuda":
        ops.set_num_threads(1)
    try:
        yield
    finally:
        ops.set_num_threads(threads)
