"""Marks on a device's own time line: what runs asynchronously is timed without waiting for it."""

import time
from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import Any

import torch


class DeviceEvent(ABC):
    """A place on a device's time line; marks of one kind can be compared."""

    @abstractmethod
    def is_complete(self) -> bool:
        """Whether all work before the mark is done."""

    @abstractmethod
    def wait(self) -> None:
        """Returns once all work before the mark is done; what other streams do is not waited for."""

    @abstractmethod
    def ms_since(self, earlier: Any) -> float:
        """Milliseconds from an earlier mark to this one; both must have passed."""


class HostEvent(DeviceEvent):
    """Now, for work that is done when its call returns."""

    def __init__(self):
        self._time_s = time.perf_counter()

    def is_complete(self) -> bool:
        return True

    def wait(self) -> None:
        pass

    def ms_since(self, earlier: "HostEvent") -> float:
        return 1e3 * (self._time_s - earlier._time_s)


class StreamEvent(DeviceEvent):
    """When a CUDA stream gets to this place in its queue."""

    def __init__(self, stream: torch.cuda.Stream):
        self.event = torch.cuda.Event(enable_timing=True)
        self.event.record(stream)

    def is_complete(self) -> bool:
        return self.event.query()

    def wait(self) -> None:
        self.event.synchronize()

    def ms_since(self, earlier: "StreamEvent") -> float:
        return earlier.event.elapsed_time(self.event)


def event_recorder(device: torch.device) -> Callable[[], DeviceEvent]:
    """Makes marks of when the device has done all it was given so far: on CUDA by this thread's current stream."""
    if device.type != "cuda":
        return HostEvent
    stream = torch.cuda.current_stream(device)
    return lambda: StreamEvent(stream)
