"""Events in a device's queue: what runs asynchronously is timed without waiting for it."""

import itertools
import time
from abc import ABC, abstractmethod
from collections import defaultdict
from collections.abc import Callable
from typing import Any

import numpy as np
import torch

PIECE_BYTES = 1 << 20  # of page-locked memory


class DeviceEvent(ABC):
    """A place in a device's queue; events of one kind can be compared."""

    @abstractmethod
    def is_complete(self) -> bool:
        """Whether all work before the event is done."""

    @abstractmethod
    def wait(self) -> None:
        """Returns once all work before the event is done; other streams are not waited for."""

    @abstractmethod
    def ms_since(self, earlier: Any) -> float:
        """Milliseconds from an earlier event to this one; both must be complete."""


class HostEvent(DeviceEvent):
    """The present time, for work that is done when its call returns."""

    def __init__(self):
        self._time_s = time.perf_counter()

    def is_complete(self) -> bool:
        return True

    def wait(self) -> None:
        pass

    def ms_since(self, earlier: "HostEvent") -> float:
        return 1e3 * (self._time_s - earlier._time_s)


# CUDA events that nobody refers to any more, by device: to make one takes longer than to record it.
_SPARE_EVENTS: defaultdict[int, list[torch.cuda.Event]] = defaultdict(list)


class StreamEvent(DeviceEvent):
    """A CUDA event, complete when its stream gets to this place in its queue."""

    def __init__(self, stream: torch.cuda.Stream):
        self._spare = _SPARE_EVENTS[stream.device_index]
        try:
            self.event = self._spare.pop()
        except IndexError:
            self.event = torch.cuda.Event(enable_timing=True)
        self.event.record(stream)

    def __del__(self):
        # A queue that waits for it waits for what had been recorded when it was told to.
        if hasattr(self, "event"):  # else it could not be made
            self._spare.append(self.event)

    def is_complete(self) -> bool:
        return self.event.query()

    def wait(self) -> None:
        self.event.synchronize()

    def ms_since(self, earlier: "StreamEvent") -> float:
        return earlier.event.elapsed_time(self.event)


def current_stream(device: torch.device) -> torch.cuda.Stream:
    """This thread's, by the device's number: torch takes three times as long to look up a device."""
    return torch.cuda.current_stream(device.index)


def event_recorder(device: torch.device) -> Callable[[], DeviceEvent]:
    """Records events of all work given to the device so far: on CUDA in this thread's current stream."""
    if device.type != "cuda":
        return HostEvent
    stream = current_stream(device)
    return lambda: StreamEvent(stream)


def host_copy(tensor: torch.Tensor) -> torch.Tensor:
    """A tensor on the CPU, contiguous: itself if it is so already; waits for this thread's stream.

    A large one comes in pieces by page-locked memory: while the driver copies to any other, threads that launch
    something else wait for it.
    """
    if tensor.device.type == "cpu":
        return tensor.contiguous()
    source, copy = tensor.contiguous().view(-1), torch.empty(tensor.shape, dtype=tensor.dtype)
    size = max(PIECE_BYTES // tensor.element_size(), 1)
    staging = torch.empty(min(size, len(source)), dtype=tensor.dtype, pin_memory=True)
    record = event_recorder(tensor.device)
    for piece, part in zip(copy.view(-1).split(size), source.split(size), strict=True):
        staged = staging[: len(part)]
        staged.copy_(part, non_blocking=True)
        record().wait()
        piece.copy_(staged)
    return copy


def read_together(*tensors: torch.Tensor) -> list[np.ndarray]:
    """float32 tensors of one device, flat; the host waits for the device once."""
    numbers = torch.cat([tensor.reshape(-1) for tensor in tensors]).cpu().numpy()
    return np.split(numbers, list(itertools.accumulate(tensor.numel() for tensor in tensors[:-1])))


def fetch(numbers: torch.Tensor) -> torch.Tensor:
    """A copy of a tensor that is on its way to the CPU; to be read once the device is done."""
    if numbers.device.type == "cpu":
        return numbers.clone()
    return torch.empty_like(numbers, device="cpu", pin_memory=True).copy_(numbers, non_blocking=True)
