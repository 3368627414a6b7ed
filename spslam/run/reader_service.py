"""What the process does that reads frames for a `ReaderProcess`."""

import contextlib
import mmap
import pickle
import traceback
from collections import deque
from dataclasses import dataclass
from multiprocessing.connection import Connection
from typing import cast

import cv2
import numpy as np
import torch

from spslam import ops
from spslam.config import Config
from spslam.datasets.base import RgbdDataset
from spslam.datasets.prefetch import prefetch
from spslam.errors import DatasetError
from spslam.slam.pixels import FramePixels
from spslam.slam.prepared_frame import FramePreparation

# How either side learns that the other is gone.
GONE = (EOFError, ConnectionError)


@dataclass(frozen=True)
class Work:
    """What the reader is to do; `workers` threads, `ahead` frames beyond those that lie in the slots."""

    dataset: RgbdDataset
    config: Config
    start: int
    workers: int
    ahead: int
    slots: int
    words: int


@dataclass(frozen=True)
class Message:
    """What the reader tells: of a frame, of one that can't be read, that there are no more, or that it must stop.

    Attributes:
        read_ms: time that a thread spent on it.
        slot: where the frame's pixels are; None where there is no frame.
        index, timestamp, decode_ms: as in `PreparedFrame`.
        valid_depth_share: as in `FramePixels`.
        error: in place of a frame.
        failure: traceback of an exception that is no fault of the data.
    """

    read_ms: float = 0.0
    slot: int | None = None
    index: int = 0
    timestamp: float = 0.0
    decode_ms: float = 0.0
    valid_depth_share: float = 0.0
    error: DatasetError | None = None
    failure: str | None = None


def mapped(shared: int, slots: int, words: int) -> torch.Tensor:
    """int32 [slots, words] in the memory of a file descriptor."""
    content = np.frombuffer(mmap.mmap(shared, 0), np.int32, slots * words)
    return torch.from_numpy(content).view(slots, words)


def serve(socket: int, shared: int) -> None:
    """The reader's side, in its own process: takes the work, and tells of each frame.

    Args:
        socket: file descriptor of the connection to the loop.
        shared: of the memory.
    """
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    ops.set_num_threads(1)
    with contextlib.suppress(*GONE), Connection(socket) as connection:
        try:
            work: Work = pickle.loads(connection.recv_bytes())
        except (AttributeError, ImportError):  # a data set of a class that isn't known here
            connection.send(False)
            return
        connection.send(True)
        connection.recv()
        try:
            _tell_frames(work, mapped(shared, work.slots, work.words), connection)
        except GONE:
            raise
        except Exception:
            connection.send(Message(failure=traceback.format_exc()))


def _tell_frames(work: Work, memory: torch.Tensor, connection: Connection) -> None:
    preparation = FramePreparation(work.dataset, work.config, work.start)
    free, before = deque(range(work.slots)), 0.0
    with prefetch(preparation, work.workers, work.ahead) as frames:
        for frame in frames:
            read_ms, before = 1e3 * (frames.read_seconds - before), frames.read_seconds
            if isinstance(frame, DatasetError):
                connection.send(Message(read_ms, error=frame))
                continue
            slot, pixels = _free_slot(free, connection), cast(FramePixels, frame.pixels)
            memory[slot].copy_(pixels.buffer)
            told = (frame.index, frame.timestamp, frame.decode_ms, pixels.valid_depth_share)
            connection.send(Message(read_ms, slot, *told))
    connection.send(Message())
    with contextlib.suppress(*GONE):
        while True:
            connection.recv()


def _free_slot(free: deque[int], connection: Connection) -> int:
    while not free or connection.poll():
        free.append(connection.recv())
    return free.popleft()
