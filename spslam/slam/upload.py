"""Asynchronous upload of frames to a CUDA device."""

import contextlib
import threading
from dataclasses import dataclass

import torch

from spslam.slam.device_events import StreamEvent, current_stream
from spslam.slam.pixels import FramePixels


@dataclass(frozen=True)
class Upload:
    """A frame's pixels on their way to the device, on a stream of their own.

    Attributes:
        pixels: on the device; not to be read before `received`.
        source: the same in page-locked memory, not to be changed until `end` is complete.
        begin, end: of the copy.
    """

    pixels: FramePixels
    source: FramePixels
    begin: StreamEvent
    end: StreamEvent

    def received(self) -> FramePixels:
        """The pixels, for work submitted to the current stream from now on; does not wait."""
        stream = current_stream(self.pixels.buffer.device)
        stream.wait_event(self.end.event)
        # Their memory must not be given to another upload while this stream may read it.
        self.pixels.buffer.record_stream(stream)
        return self.pixels


class Uploader:
    """Copies frames to a CUDA device asynchronously; each thread that uses it has a stream of its own."""

    def __init__(self, device: torch.device):
        self.device = device
        self._own = threading.local()

    def send(self, pixels: FramePixels) -> Upload:
        """Starts the copy and returns."""
        buffer = pixels.buffer
        source = pixels if buffer.is_pinned() else pixels.holding(buffer.pin_memory())
        stream = self._stream()
        with torch.cuda.stream(stream):
            buffer = torch.empty(len(source.buffer), dtype=torch.int32, device=self.device)
            begin = StreamEvent(stream)
            buffer.copy_(source.buffer, non_blocking=True)
            return Upload(pixels.holding(buffer), source, begin, StreamEvent(stream))

    def _stream(self) -> torch.cuda.Stream:
        if not hasattr(self._own, "stream"):
            self._own.stream = torch.cuda.Stream(self.device)
        return self._own.stream

    def lock_pages(self, memory: torch.Tensor) -> bool:
        """Locks the pages of memory that this process only maps, so that copies out of it wait for nothing.

        Returns:
            Whether that is allowed here; where not, copies are slower and nothing else changes.
        """
        runtime = torch.cuda.cudart()
        if runtime.cudaHostRegister(memory.data_ptr(), memory.nbytes, 0) == runtime.cudaError.success:
            return True
        with contextlib.suppress(RuntimeError):
            torch.zeros(1, device=self.device)  # clears the pending error, which the next launch would report
        return False

    @staticmethod
    def unlock_pages(memory: torch.Tensor) -> None:
        """Undoes `lock_pages` where that was done; all copies must have ended."""
        torch.cuda.cudart().cudaHostUnregister(memory.data_ptr())
