"""Asynchronous upload of frames to a CUDA device."""

import contextlib
import threading
from dataclasses import dataclass

import numpy as np
import torch

from spslam.camera import Camera
from spslam.config import Config
from spslam.datasets.base import RgbdFrame
from spslam.slam.device_events import StreamEvent, current_stream, fetch
from spslam.slam.pixels import FramePixels, sample_images


@dataclass(frozen=True)
class Upload:
    """A frame's pixels on their way to the device, on a stream of their own.

    Attributes:
        pixels: on the device; not to be read before `received`.
        source: page-locked memory that is copied, not to be changed until `end` is complete; None where it is by then.
        begin, end: of the copy.
    """

    pixels: FramePixels
    source: torch.Tensor | None
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
        self._locked = 0  # where the memory begins whose pages are locked; nowhere

    def send(self, pixels: FramePixels) -> Upload:
        """Starts the copy and returns."""
        buffer = pixels.buffer
        is_locked = buffer.untyped_storage().data_ptr() == self._locked or buffer.is_pinned()  # to ask takes longer
        source = buffer if is_locked else buffer.pin_memory()
        stream = self._stream()
        with torch.cuda.stream(stream):
            buffer = torch.empty(len(source), dtype=torch.int32, device=self.device)
            begin = StreamEvent(stream)
            buffer.copy_(source, non_blocking=True)
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
            self._locked = memory.untyped_storage().data_ptr()
            return True
        with contextlib.suppress(RuntimeError):
            torch.zeros(1, device=self.device)  # clears the pending error, which the next launch would report
        return False

    def unlock_pages(self, memory: torch.Tensor) -> None:
        """Undoes `lock_pages` where that was done; all copies must have ended."""
        self._locked = 0
        torch.cuda.cudart().cudaHostUnregister(memory.data_ptr())


class ImageUploader:
    """Copies the images of single frames to a CUDA device, which samples them in less time than the copy takes.

    For one thread at a time: all frames pass through the same page-locked memory.

    Args:
        device: the device.
        camera: of all frames.
        config: how they are sampled.
    """

    def __init__(self, device: torch.device, camera: Camera, config: Config):
        self.device, self._camera, self._config = device, camera, config
        self._stream = torch.cuda.Stream(device)
        size = camera.height, camera.width
        self._depth = torch.empty(size, dtype=torch.float32, pin_memory=True)
        self._color = torch.empty((*size, 3), dtype=torch.uint8, pin_memory=True)

    def sample(self, frame: RgbdFrame) -> Upload:
        """Copies a frame's images and samples them; waits until that is done, but not for the device's other work."""
        np.copyto(self._depth.numpy(), frame.depth)
        np.copyto(self._color.numpy(), frame.color)
        with torch.cuda.stream(self._stream):
            begin = StreamEvent(self._stream)
            depth, color = (image.to(self.device, non_blocking=True) for image in (self._depth, self._color))
            end = StreamEvent(self._stream)
            pixels = sample_images(depth, color, frame.index, self._camera, self._config)
            return Upload(pixels, None, begin, end)  # it was sampled by now: that waits

    def fetch_images(self, pixels: FramePixels) -> tuple[FramePixels, StreamEvent]:
        """The small images of a frame that was sampled, on their way to the host, and when they are there."""
        with torch.cuda.stream(self._stream):
            return pixels.only_images(fetch), StreamEvent(self._stream)
