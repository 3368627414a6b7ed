"""Reading frames ahead on threads, so that decoding doesn't hold up the system."""

from __future__ import annotations

import os
import time
from collections import deque
from collections.abc import Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from types import TracebackType
from typing import Generic, Protocol, TypeVar

from spslam.errors import DatasetError

Frame = TypeVar("Frame")
ReadFrame = TypeVar("ReadFrame", covariant=True)


def usable_cores() -> int:
    """Number of cores that this process may run on, at least 1."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


class Readable(Protocol[ReadFrame]):
    """What is read ahead: an `RgbdDataset`, or whatever else has frames by number, from any thread."""

    def __len__(self) -> int: ...

    def __getitem__(self, index: int, /) -> ReadFrame: ...


class Prefetcher(Iterator[Frame | DatasetError], Generic[Frame]):
    """Frames of a dataset in order, read by threads up to `ahead` frames in advance.

    A frame that can't be read comes as its DatasetError in the frame's place (not raised): the caller decides what to
    do. Any other exception is a bug and is raised in that place. The threads end with the last frame, with `close()`,
    on leaving a `with` block, and on any exception that passes through, Ctrl-C included.

    Args:
        dataset: the frames.
        workers: threads; 0 reads each frame when it is asked for.
        ahead: most frames read in advance.

    Attributes:
        frames_read: frames handed out so far, broken ones included.
        read_seconds: time spent on reading those, summed over the threads.

    Raises:
        ValueError: `workers` is negative, or `ahead` below 1.
    """

    def __init__(self, dataset: Readable[Frame], workers: int = 2, ahead: int = 8) -> None:
        if workers < 0:
            raise ValueError(f"prefetch: workers must be at least 0, got {workers}")
        if ahead < 1:
            raise ValueError(f"prefetch: ahead must be at least 1, got {ahead}")
        self._dataset = dataset
        self._ahead = ahead
        self._next = 0
        self._pending: deque[Future[tuple[Frame | DatasetError, float]]] = deque()
        self._threads = ThreadPoolExecutor(workers, thread_name_prefix="spslam-prefetch") if workers else None
        self.frames_read = 0
        self.read_seconds = 0.0

    def __next__(self) -> Frame | DatasetError:
        try:
            return self._take_next()
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        """Drops what was read ahead and waits for the threads to end. May be called again."""
        self._next = len(self._dataset)
        self._pending.clear()
        if self._threads is not None:
            self._threads.shutdown(wait=True, cancel_futures=True)

    def __enter__(self) -> Prefetcher[Frame]:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self.close()

    def _take_next(self) -> Frame | DatasetError:
        frame, seconds = self._read_in_place() if self._threads is None else self._wait_for_oldest(self._threads)
        self.read_seconds += seconds
        self.frames_read += 1
        return frame

    def _read_in_place(self) -> tuple[Frame | DatasetError, float]:
        if self._next >= len(self._dataset):
            raise StopIteration
        self._next += 1
        return _timed_read(self._dataset, self._next - 1)

    def _wait_for_oldest(self, threads: ThreadPoolExecutor) -> tuple[Frame | DatasetError, float]:
        self._submit_reads(threads)
        if not self._pending:
            raise StopIteration
        oldest = self._pending.popleft()
        result = oldest.result()
        self._submit_reads(threads)
        return result

    def _submit_reads(self, threads: ThreadPoolExecutor) -> None:
        while len(self._pending) < self._ahead and self._next < len(self._dataset):
            self._pending.append(threads.submit(_timed_read, self._dataset, self._next))
            self._next += 1


def prefetch(dataset: Readable[Frame], workers: int = 2, ahead: int = 8) -> Prefetcher[Frame]:
    """Reads a dataset's frames in order, `ahead` frames in advance, on `workers` threads; see `Prefetcher`.

    At most `ahead` + 1 decoded frames exist at a time. What the frames hold doesn't depend on the number of threads.

    Args:
        dataset: the frames.
        workers: threads; 0 reads each frame when it is asked for.
        ahead: most frames read in advance.

    Example:
        >>> from spslam.datasets.generated import GeneratedDataset
        >>> with prefetch(GeneratedDataset(2, 32, 24), workers=1) as frames:
        ...     [frame.index for frame in frames if not isinstance(frame, DatasetError)]
        [0, 1]
    """
    return Prefetcher(dataset, workers, ahead)


def _timed_read(dataset: Readable[Frame], index: int) -> tuple[Frame | DatasetError, float]:
    started = time.perf_counter()
    frame: Frame | DatasetError
    try:
        frame = dataset[index]
    except DatasetError as error:
        frame = error
    return frame, time.perf_counter() - started
