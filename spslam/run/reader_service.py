"""What the process that reads frames runs, for a `ReaderProcess`."""

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
from spslam.datasets.clock import AT_ONCE, CaptureOffsets
from spslam.datasets.frozen_depth import FrameSignature
from spslam.datasets.prefetch import prefetch
from spslam.errors import DatasetError
from spslam.slam.image_features import ImageFeatures
from spslam.slam.pixels import FramePixels
from spslam.slam.prepared_frame import FramePreparation

# Raised by a connection whose other end is closed.
DISCONNECTED = (EOFError, ConnectionError)


@dataclass(frozen=True)
class Work:
    """What the process is to read.

    Attributes:
        dataset: the frames.
        config: how they are sampled.
        start: position of the first frame.
        workers: number of reading threads.
        ahead: number of frames kept ready beyond those in the slots.
        slots: number of slots in the shared memory.
        words: size of a slot in 32-bit words.
    """

    dataset: RgbdDataset
    config: Config
    start: int
    workers: int
    ahead: int
    slots: int
    words: int


@dataclass(frozen=True)
class Message:
    """From the process: a frame, a frame that can't be read, a failure, or the end of the dataset (all defaults).

    Attributes:
        read_ms: time that a reading thread spent on the frame.
        slot: slot that holds the frame's pixels; None where there is no frame.
        index, timestamp, decode_ms, signature, features, offsets: as in `PreparedFrame`.
        valid_depth_share: as in `FramePixels`.
        error: of a frame that can't be read.
        failure: traceback of an exception that is not the data's fault; the process then ends.
    """

    read_ms: float = 0.0
    slot: int | None = None
    index: int = 0
    timestamp: float = 0.0
    decode_ms: float = 0.0
    valid_depth_share: float = 0.0
    signature: FrameSignature | None = None
    features: ImageFeatures | None = None
    offsets: CaptureOffsets = AT_ONCE
    error: DatasetError | None = None
    failure: str | None = None


def mapped(shared: int, slots: int, words: int) -> torch.Tensor:
    """Maps the shared memory.

    Args:
        shared: its file descriptor.
        slots: number of slots.
        words: size of a slot in 32-bit words.

    Returns:
        int32 [slots, words].
    """
    content = np.frombuffer(mmap.mmap(shared, 0), np.int32, slots * words)
    return torch.from_numpy(content).view(slots, words)


def serve(socket: int, shared: int) -> None:
    """Main function of the process: receives the work, then sends a message per frame.

    Args:
        socket: file descriptor of the connection to the frame loop.
        shared: file descriptor of the shared memory.
    """
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    ops.set_num_threads(1)
    with contextlib.suppress(*DISCONNECTED), Connection(socket) as connection:
        try:
            work: Work = pickle.loads(connection.recv_bytes())
        except (AttributeError, ImportError):  # the dataset's class can't be imported here
            connection.send(False)
            return
        connection.send(True)
        connection.recv()
        try:
            _send_frames(work, mapped(shared, work.slots, work.words), connection)
        except DISCONNECTED:
            raise
        except Exception:
            connection.send(Message(failure=traceback.format_exc()))


def _send_frames(work: Work, memory: torch.Tensor, connection: Connection) -> None:
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
            described = (frame.index, frame.timestamp, frame.decode_ms, pixels.valid_depth_share)
            connection.send(Message(read_ms, slot, *described, frame.signature, frame.features, frame.offsets))
    connection.send(Message())
    # Stay until the loop closes the connection: it still returns slots.
    with contextlib.suppress(*DISCONNECTED):
        while True:
            connection.recv()


def _free_slot(free: deque[int], connection: Connection) -> int:
    while not free or connection.poll():
        free.append(connection.recv())
    return free.popleft()
