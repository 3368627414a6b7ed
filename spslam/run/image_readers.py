"""A dataset whose images several processes read, for what reads all of a recording again. Does not import torch.

Threads of one process take turns for Python's interpreter some thirty times a frame, and hold up the thread that works
on what they read. Here they only ask a process and copy what it has left in memory that both map. See `image_service`
for what the processes run.
"""

from __future__ import annotations

import contextlib
import mmap
import os
import pickle
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from multiprocessing import Pipe
from multiprocessing.connection import Connection
from queue import SimpleQueue
from typing import Any

import numpy as np

from spslam.datasets.base import RgbdDataset, RgbdFrame, Subset
from spslam.datasets.prefetch import usable_cores
from spslam.errors import SpslamError
from spslam.helper_process import DISCONNECTED, HelperProcess, Standby
from spslam.run.reader_launch import READER_ENVIRONMENT

# What the first process runs, which forks the others; a test checks that it exists.
SERVICE_MODULE, SERVICE_FUNCTION = "spslam.run.image_service", "serve"
# Fewer hardly read faster than threads; more wait for the thread that works on what they read.
MIN_READERS, MAX_READERS = 4, 12
LEAST_FRAMES = 30  # fewer are read before the processes have started
MOST_BYTES = 256 << 20  # that frames are left in; of large images fewer processes read, or none
COLOR_BYTES, DEPTH_BYTES = 3, 4  # of a pixel
DEPTH_REQUEST, FRAME_REQUEST = b"d", b"f"
INDEX_BYTES = 8


class NotSharedError(Exception):
    """Other processes can't read a dataset: it can't be pickled, its class not be imported there, or none be forked."""


@dataclass(frozen=True)
class ImageWork:
    """What the processes are to read.

    Attributes:
        dataset: the frames.
        readers: number of processes.
        frame_bytes: of the memory that each leaves a frame in.
    """

    dataset: RgbdDataset
    readers: int
    frame_bytes: int


@dataclass(frozen=True)
class LaunchedReaders:
    """A process that waits for its work, and what those that it forks will have.

    Attributes:
        helper: the process.
        connections: to each that it forks.
        shared: file descriptor of memory, empty as yet, that all have open.
    """

    helper: HelperProcess
    connections: tuple[Connection, ...]
    shared: int

    def end(self) -> None:
        """Ends all of them; they have nothing to save."""
        for connection in self.connections:
            connection.close()
        os.close(self.shared)
        self.helper.end()


def launch() -> LaunchedReaders:
    """Starts the process for as many readers as three of four cores.

    Raises:
        OSError, TypeError: it can't be started, or there are too few cores.
    """
    count = min(3 * usable_cores() // 4, MAX_READERS)
    if count < MIN_READERS:
        raise OSError(f"{usable_cores()} cores are too few for {MIN_READERS} processes")
    with contextlib.ExitStack() as theirs, contextlib.ExitStack() as ours:
        shared = os.memfd_create("spslam-images")
        ours.callback(os.close, shared)
        own, ends = [], [shared]
        for _ in range(count):
            mine, other = Pipe()
            ours.callback(mine.close)
            theirs.callback(other.close)
            own.append(mine)
            ends.append(other.fileno())
        helper = HelperProcess.launch(SERVICE_MODULE, SERVICE_FUNCTION, READER_ENVIRONMENT, tuple(ends))
        ours.pop_all()
    return LaunchedReaders(helper, tuple(own), shared)


IMAGE_READERS = Standby(launch)


@contextlib.contextmanager
def shared_out(dataset: RgbdDataset) -> Iterator[RgbdDataset]:
    """The dataset, read by the processes on standby where they are there and it can be shared out.

    What it holds is the same; in any other case it is the dataset itself.
    """
    shared = None
    pays = dataset.is_random_access and len(dataset) >= LEAST_FRAMES and _most_readers(dataset) >= MIN_READERS
    if pays and IMAGE_READERS.waiting is not None:
        with contextlib.suppress(NotSharedError):
            shared = SharedOutDataset(dataset, IMAGE_READERS.take())
    if shared is None:
        yield dataset
        return
    with contextlib.closing(shared):
        yield shared


class SharedOutDataset(Subset):
    """All frames of a dataset, each read by one of several processes; from any thread, as of any dataset.

    Args:
        dataset: the frames; `is_random_access`.
        launched: the processes, which end with this.

    Raises:
        NotSharedError: they can't read it; they have ended then.
    """

    def __init__(self, dataset: RgbdDataset, launched: LaunchedReaders) -> None:
        super().__init__(dataset)
        self._launched = launched
        self.readers = min(len(launched.connections), max(_most_readers(dataset), 1))
        work = ImageWork(dataset, self.readers, _frame_bytes(dataset))
        try:
            os.ftruncate(launched.shared, self.readers * work.frame_bytes)
            memory = np.frombuffer(mmap.mmap(launched.shared, 0), np.uint8)
            _begin(launched.helper.connection, work)
        except BaseException:
            launched.end()
            raise
        self._images = [images_in(memory, number, work) for number in range(self.readers)]
        self._free: SimpleQueue[int] = SimpleQueue()
        for reader in range(self.readers):
            self._free.put(reader)

    def close(self) -> None:
        """Ends the processes; nothing can be read any more."""
        self._launched.end()

    def __getitem__(self, index: int) -> RgbdFrame:
        with self._answer(FRAME_REQUEST, self._checked_index(index)) as (answer, depth, color):
            if answer is not None:
                return RgbdFrame(color=color.copy(), depth=depth.copy(), **answer)
        return self._dataset[index]  # which says what is wrong with it

    def depth(self, index: int) -> np.ndarray:
        """As `RgbdDataset.depth`."""
        with self._answer(DEPTH_REQUEST, self._checked_index(index)) as (answer, depth, _):
            if answer is not None:
                return depth.copy()
        return self._dataset.depth(index)

    @contextlib.contextmanager
    def _answer(self, kind: bytes, index: int) -> Iterator[tuple[dict[str, Any] | None, np.ndarray, np.ndarray]]:
        """What a process says of a frame, None where it can't be read, with the images that it has left."""
        reader = self._free.get()
        connection = self._launched.connections[reader]
        try:
            connection.send_bytes(kind + index.to_bytes(INDEX_BYTES, "little"))
            answer, failure = connection.recv()
            if failure is not None:
                raise RuntimeError(f"reading frames failed:\n{failure}")
            yield answer, *self._images[reader]
        except DISCONNECTED:
            what = f"{self.name}: a process that reads frames has ended"
            threads = "run.reader=threads (for spslam mesh in the run's config.yaml)"
            raise SpslamError(f"{what}; if memory was short, {threads} needs none") from None
        finally:
            self._free.put(reader)


def _most_readers(dataset: RgbdDataset) -> int:
    return MOST_BYTES // _frame_bytes(dataset)


def _frame_bytes(dataset: RgbdDataset) -> int:
    return dataset.camera.width * dataset.camera.height * (DEPTH_BYTES + COLOR_BYTES)


def _begin(connection: Connection, work: ImageWork) -> None:
    """Sends the work, and waits until the processes are there; raises NotSharedError."""
    try:
        content = pickle.dumps(work)
    except (pickle.PicklingError, AttributeError, TypeError) as error:
        raise NotSharedError from error
    try:
        connection.send_bytes(content)
        is_ready = connection.recv()
    except DISCONNECTED as error:
        raise NotSharedError from error
    if not is_ready:
        raise NotSharedError


def images_in(memory: np.ndarray, number: int, work: ImageWork) -> Sequence[np.ndarray]:
    """Depth float32 [H, W] and color uint8 [H, W, 3] of a frame, as a reader of some number leaves them."""
    size = work.dataset.camera.height, work.dataset.camera.width
    own = memory[number * work.frame_bytes :][: work.frame_bytes]
    depth_bytes = DEPTH_BYTES * size[0] * size[1]
    return own[:depth_bytes].view(np.float32).reshape(size), own[depth_bytes:].reshape(*size, COLOR_BYTES)
