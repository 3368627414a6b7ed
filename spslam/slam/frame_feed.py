"""Frames read, decoded, sampled and brought to the device on threads, ahead of need."""

import os
import threading
import time
from collections.abc import Iterator
from contextlib import AbstractContextManager
from dataclasses import dataclass
from types import TracebackType

import torch

from spslam.config import Config
from spslam.datasets.base import RgbdDataset
from spslam.datasets.prefetch import prefetch
from spslam.errors import DatasetError
from spslam.slam.pixels import FramePixels, sample_frame
from spslam.slam.timeline import Mark, StreamMark, marker

# More threads than this decode no faster: they would wait for each other's turn at the interpreter.
MOST_WORKERS = 16
LEAST_WORKERS = 2
LEAST_AHEAD = 8


@dataclass(frozen=True)
class Upload:
    """A frame's pixels on their way to the device, on a stream of their own.

    Attributes:
        pixels: on the device; not to be read before `received`.
        source: the same in page-locked memory, kept until then.
        begin, end: of the copy.
    """

    pixels: FramePixels
    source: FramePixels
    begin: StreamMark
    end: StreamMark

    def received(self) -> FramePixels:
        """The pixels, for work that is given to the current stream from now on; the host waits for nothing."""
        stream = torch.cuda.current_stream(self.pixels.buffer.device)
        stream.wait_event(self.end.event)
        # Their memory must not be given to another upload while this stream may read it.
        self.pixels.buffer.record_stream(stream)
        return self.pixels


class Uploader:
    """Copies frames to a CUDA device beside whatever it does; each thread that uses it has a stream of its own."""

    def __init__(self, device: torch.device):
        self.device = device
        self._own = threading.local()

    def send(self, pixels: FramePixels) -> Upload:
        """Starts the copy and returns."""
        source = pixels.holding(pixels.buffer.pin_memory())
        stream = self._stream()
        with torch.cuda.stream(stream):
            buffer = torch.empty(len(source.buffer), dtype=torch.int32, device=self.device)
            begin = StreamMark(stream)
            buffer.copy_(source.buffer, non_blocking=True)
            return Upload(pixels.holding(buffer), source, begin, StreamMark(stream))

    def _stream(self) -> torch.cuda.Stream:
        if not hasattr(self._own, "stream"):
            self._own.stream = torch.cuda.Stream(self.device)
        return self._own.stream


@dataclass
class PreparedFrame:
    """What the system needs of a frame; the images are let go.

    Attributes:
        index: of the frame in the data set; keys its draws.
        timestamp: s.
        pixels: on the CPU, or on their way to the device.
        decode_ms: reading, decoding and sampling, on the thread that did it.
        wait_ms: how long the host waited for the frame.
        asked: when it was asked for; None where nobody kept the time.
    """

    index: int
    timestamp: float
    pixels: FramePixels | Upload
    decode_ms: float = 0.0
    wait_ms: float = 0.0
    asked: Mark | None = None


class FrameFeed(Iterator[PreparedFrame | DatasetError], AbstractContextManager):
    """The frames of a data set from a position on, in order; one that can't be read comes as its error.

    What the frames hold does not depend on the number of threads. At most `run.prefetch_ahead` frames exist at a time.
    """

    def __init__(self, dataset: RgbdDataset, config: Config, device: torch.device, start: int = 0):
        run = config.run
        workers = automatic_workers(device) if run.prefetch_workers is None else run.prefetch_workers
        ahead = max(2 * workers, LEAST_AHEAD) if run.prefetch_ahead is None else run.prefetch_ahead
        self._mark = marker(device)
        self._reader = prefetch(_Preparation(dataset, config, device, start), workers, ahead)

    @property
    def decode_seconds(self) -> float:
        """Time spent on preparing the frames handed out, summed over the threads."""
        return self._reader.read_seconds

    def __next__(self) -> PreparedFrame | DatasetError:
        asked, began = self._mark(), time.perf_counter()
        item = next(self._reader)
        if isinstance(item, PreparedFrame):
            item.asked, item.wait_ms = asked, 1e3 * (time.perf_counter() - began)
        return item

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self._reader.close()


class _Preparation:
    """What the threads do with a frame."""

    def __init__(self, dataset: RgbdDataset, config: Config, device: torch.device, start: int):
        self._dataset, self._config, self._start = dataset, config, start
        self._uploader = Uploader(device) if device.type == "cuda" else None

    def __len__(self) -> int:
        return len(self._dataset) - self._start

    def __getitem__(self, i: int) -> PreparedFrame:
        began = time.perf_counter()
        frame = self._dataset[i + self._start]
        pixels = sample_frame(frame, self._dataset.camera, self._config)
        decode_ms = 1e3 * (time.perf_counter() - began)
        sent = self._uploader.send(pixels) if self._uploader else pixels
        return PreparedFrame(frame.index, frame.timestamp, sent, decode_ms)


def automatic_workers(device: torch.device) -> int:
    """Reading threads for a run on `device`: a GPU is fed by all cores but the loop's, CPU kernels get by with few."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    wanted = cores - 1 if device.type == "cuda" else cores // 4
    return min(max(wanted, LEAST_WORKERS), MOST_WORKERS)
