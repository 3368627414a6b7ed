"""Asynchronous reading: frames are read, decoded, sampled and uploaded ahead of need, here or in another process."""

import time
from collections import deque
from collections.abc import Iterator
from contextlib import AbstractContextManager, contextmanager
from types import TracebackType

import torch

from spslam.config import Config
from spslam.datasets.base import RgbdDataset
from spslam.datasets.prefetch import Prefetcher, prefetch, usable_cores
from spslam.errors import DatasetError
from spslam.run.frozen_frames import FrozenFrames
from spslam.run.reader_launch import AHEAD_PER_WORKER, READERS
from spslam.run.reader_process import ReaderProcess, ReaderUnavailableError
from spslam.slam.device_events import event_recorder
from spslam.slam.prepared_frame import FramePreparation, PreparedFrame
from spslam.slam.upload import Uploader

# More of them hardly read faster, and slow down the frame loop.
MAX_WORKERS = 16
MIN_WORKERS = 2
MIN_AHEAD = 8
# Frames that are taken ahead and sent to a device at a time: one by one, between other work, each would take longer.
SENT_TOGETHER = 4


class FrameFeed(Iterator[PreparedFrame | DatasetError], AbstractContextManager):
    """Iterates over the frames of a dataset in order; a frame that can't be read, or whose depth stream is frozen,
    comes as its `DatasetError`.

    The content of the frames depends neither on the number of threads nor on their process (`run.reader`): threads of
    another process do not compete with the frame loop for Python's GIL. If `run.reader` is `auto`, a dataset that no
    other process can read is read by threads of this one; if it is `process`, that is an error. At most
    `run.prefetch_ahead` frames exist at the same time, and a few more that were sent to the device. Another process
    reads the first ones while this one loads kernels; threads begin when the first one is requested.

    Args:
        dataset: the frames.
        config: how they are read and sampled.
        device: receives the pixels.
        start: position of the first frame.
        processed: number of frames before it that were processed; those that could not be read were not.

    Raises:
        ReaderUnavailableError: `run.reader` is `process`, and no other process can read the dataset: it can't be
            pickled, its class can't be imported there (raised by `prepare`), or no process can be started.
    """

    def __init__(
        self, dataset: RgbdDataset, config: Config, device: torch.device, start: int = 0, processed: int | None = None
    ):
        self._record = event_recorder(device)
        self._frozen = FrozenFrames(dataset, start)
        run, processed = config.run, start if processed is None else processed
        workers = automatic_workers(device) if run.prefetch_workers is None else run.prefetch_workers
        ahead = max(AHEAD_PER_WORKER * workers, MIN_AHEAD) if run.prefetch_ahead is None else run.prefetch_ahead
        uploader = Uploader(device) if device.type == "cuda" else None
        self._threads = prefetch(FramePreparation(dataset, config, start, uploader), workers, ahead)
        self._may_fall_back = run.reader == "auto"
        self._process: ReaderProcess | None = None
        if uses_process(run.reader, device):
            with self._fallback():
                self._process = ReaderProcess.start(dataset, config, (start, processed), workers, ahead, uploader)
        self._reader: Prefetcher[PreparedFrame] | ReaderProcess | None = None
        # The next frames, or what is to be raised instead, where they were taken ahead.
        self._ahead: deque[PreparedFrame | DatasetError | Exception] = deque()

    def prepare(self) -> Iterator[PreparedFrame | DatasetError]:
        """Waits until frames can be requested; reads none. Returns the iterator over the frames."""
        if self._reader is None:
            self._reader = self._threads
            if self._process is not None:
                with self._fallback():
                    self._process.wait_until_ready()
                    self._reader = self._process
        return self._reader

    @property
    def decode_seconds(self) -> float:
        """Time spent on preparing the frames returned so far, summed over the reading threads."""
        return self._reader.read_seconds if self._reader else 0.0

    def __next__(self) -> PreparedFrame | DatasetError:
        reader = self.prepare()
        requested, started, was_there = self._record(), time.perf_counter(), bool(self._ahead)
        item = self._frozen.checked(self._taken_ahead() or next(reader))  # the process has checked its frames already
        if isinstance(item, DatasetError):
            return item
        item.requested, item.wait_ms = requested, 0.0 if was_there else 1e3 * (time.perf_counter() - started)
        return item

    def want_features(self, wanted: bool) -> None:
        """Says whether image features of the next frames will probably be asked for: a process extracts them ahead."""
        if isinstance(self._reader, ReaderProcess):
            self._reader.want_features(wanted)

    @property
    def is_ready(self) -> bool:
        """Whether the next frame of a reading process is there; False where threads read."""
        return bool(self._ahead) or (isinstance(self._reader, ReaderProcess) and self._reader.is_ready())

    def look_ahead(self) -> None:
        """Takes the next frames from the reading process, and sends them to the device, if they are there and none is
        left of those before; does not wait.

        What is wrong with one is raised where it is requested.
        """
        if self._ahead or not isinstance(self._reader, ReaderProcess):
            return
        most = max(min(SENT_TOGETHER, self._reader.slots // 2), 1)  # the process needs some while these are held
        while len(self._ahead) < most and self._reader.is_ready():
            try:
                self._ahead.append(next(self._reader))
            except Exception as error:
                self._ahead.append(error)
                return

    def _taken_ahead(self) -> PreparedFrame | DatasetError | None:
        """The first frame that was taken ahead; None where none was."""
        if not self._ahead:
            return None
        item = self._ahead.popleft()
        if isinstance(item, Exception) and not isinstance(item, DatasetError):
            raise item
        return item

    @contextmanager
    def _fallback(self) -> Iterator[None]:
        """Where the process was not asked for, its absence is no error: the threads read instead."""
        try:
            yield
        except ReaderUnavailableError:
            if not self._may_fall_back:
                self._threads.close()
                raise

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self._threads.close()
        if self._process is not None:
            self._process.close()


def uses_process(reader: str, device: torch.device) -> bool:
    """Whether a separate process reads, by the value of `run.reader`: `auto` takes a standby reader for a GPU."""
    return reader == "process" or (reader == "auto" and device.type == "cuda" and READERS.waiting is not None)


def automatic_workers(device: torch.device) -> int:
    """Number of reading threads for a run on `device`: three of four cores for a GPU, one of four beside kernels."""
    cores = usable_cores()
    wanted = 3 * cores // 4 if device.type == "cuda" else cores // 4
    return min(max(wanted, MIN_WORKERS), MAX_WORKERS)
