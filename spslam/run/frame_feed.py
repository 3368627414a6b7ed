"""Frames read, decoded, sampled and brought to the device ahead of need, here or in a process of their own."""

import os
import time
from collections.abc import Iterator
from contextlib import AbstractContextManager
from types import TracebackType

import torch

from spslam.config import Config
from spslam.datasets.base import RgbdDataset
from spslam.datasets.prefetch import Prefetcher, prefetch
from spslam.errors import DatasetError
from spslam.run.reader_launch import has_standby
from spslam.run.reader_process import ReaderProcess
from spslam.slam.device_events import event_recorder
from spslam.slam.prepared_frame import FramePreparation, PreparedFrame
from spslam.slam.upload import Uploader

# More threads than this decode little faster: they wait for each other's turn at the interpreter, and slow the loop.
MOST_WORKERS = 16
LEAST_WORKERS = 2
LEAST_AHEAD = 8


class FrameFeed(Iterator[PreparedFrame | DatasetError], AbstractContextManager):
    """The frames of a data set from a position on, in order; one that can't be read comes as its error.

    What the frames hold depends neither on the number of threads nor on where these are (`run.reader`): threads of
    another process leave this one's interpreter to the loop; where the data set can't be pickled they are here. At most
    `run.prefetch_ahead` frames exist at a time. Nothing is read before the first frame is asked for.
    """

    def __init__(self, dataset: RgbdDataset, config: Config, device: torch.device, start: int = 0):
        self._record = event_recorder(device)
        run = config.run
        workers = automatic_workers(device) if run.prefetch_workers is None else run.prefetch_workers
        ahead = max(2 * workers, LEAST_AHEAD) if run.prefetch_ahead is None else run.prefetch_ahead
        uploader = Uploader(device) if device.type == "cuda" else None
        self._threads = prefetch(FramePreparation(dataset, config, start, uploader), workers, ahead)
        self._process = (
            ReaderProcess.start(dataset, config, start, workers, ahead, uploader)
            if run.reader == "process" or (run.reader == "auto" and device.type == "cuda" and has_standby())
            else None
        )
        self._reader: Prefetcher[PreparedFrame] | ReaderProcess | None = None

    def prepare(self) -> Iterator[PreparedFrame | DatasetError]:
        """Waits until frames can be asked for; reads none. Returns what gives them."""
        if self._reader is None:
            if self._process is not None and self._process.is_ready():
                self._reader = self._process
            else:
                self._reader = self._threads
        return self._reader

    @property
    def decode_seconds(self) -> float:
        """Time spent on preparing the frames handed out, summed over the threads."""
        return self._reader.read_seconds if self._reader else 0.0

    def __next__(self) -> PreparedFrame | DatasetError:
        reader = self.prepare()
        requested, started = self._record(), time.perf_counter()
        item = next(reader)
        if isinstance(item, PreparedFrame):
            item.requested, item.wait_ms = requested, 1e3 * (time.perf_counter() - started)
        return item

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self._threads.close()
        if self._process is not None:
            self._process.close()


def automatic_workers(device: torch.device) -> int:
    """Reading threads for a run on `device`: a GPU is fed by half the cores, CPU kernels get by with fewer."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    wanted = cores // 2 if device.type == "cuda" else cores // 4
    return min(max(wanted, LEAST_WORKERS), MOST_WORKERS)
