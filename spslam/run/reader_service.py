"""What the process that reads frames runs, for a `ReaderProcess`."""

import contextlib
import mmap
import pickle
import traceback
from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass
from multiprocessing.connection import Connection
from typing import NamedTuple, cast

import cv2
import numpy as np
import torch

from spslam import ops
from spslam.config import Config
from spslam.datasets.base import RgbdDataset
from spslam.datasets.prefetch import Readable, prefetch
from spslam.errors import DatasetError
from spslam.helper_process import DISCONNECTED
from spslam.run.frozen_frames import FrozenFrames
from spslam.run.reader_message import Message
from spslam.run.reader_workers import ForkedPreparation, WorkerEndedError
from spslam.slam.pixels import FramePixels, blank_pixels
from spslam.slam.prepared_frame import FramePreparation, PreparedFrame

_SLOT_BYTES = 4  # of a slot's number
_WORD_BYTES = 4
# So many processes extract image features while the loop wants some, so that it waits for few; that takes as long as
# all else, and fewer would hold the loop up.
MIN_EXTRACTING = 4


@dataclass(frozen=True)
class Work:
    """What the process is to read.

    Attributes:
        dataset: the frames.
        config: how they are sampled.
        start: position of the first frame.
        workers: number of reading threads, or of processes that each have one.
        ahead: number of frames kept ready beyond those in the slots.
        slots: number of slots in the shared memory.
        words: size of a slot in 32-bit words.
        processed: number of frames that the run has processed before.
    """

    dataset: RgbdDataset
    config: Config
    start: int
    workers: int
    ahead: int
    slots: int
    words: int
    processed: int


class SharedFrames(NamedTuple):
    """Memory that the loop, the process and those that it forks map.

    Attributes:
        slots: int32 [slots, words].
        wanted: int32 [1], whether the loop wants image features of the next frames.
    """

    slots: torch.Tensor
    wanted: np.ndarray

    @classmethod
    def mapped(cls, shared: int, slots: int, words: int) -> "SharedFrames":
        """Maps the memory.

        Args:
            shared: its file descriptor.
            slots: number of slots.
            words: size of a slot in 32-bit words.
        """
        content = np.frombuffer(mmap.mmap(shared, cls.size(slots, words)), np.int32)
        return cls(torch.from_numpy(content[:-1]).view(slots, words), content[-1:])

    @staticmethod
    def size(slots: int, words: int) -> int:
        """Bytes that it takes."""
        return _WORD_BYTES * (slots * words + 1)


def slot_message(slot: int) -> bytes:
    """What the loop sends when a slot is free again; one per frame, so nothing that has to be pickled."""
    return slot.to_bytes(_SLOT_BYTES, "little")


def _sent_slot(connection: Connection) -> int:
    return int.from_bytes(connection.recv_bytes(), "little")


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
        try:
            _serve(work, SharedFrames.mapped(shared, work.slots, work.words), connection)
        except DISCONNECTED:
            raise
        except WorkerEndedError as error:
            _send(connection, Message(ended=error.code))
        except Exception:
            _send(connection, Message(failure=traceback.format_exc()))
        # Stay until the loop closes the connection: it still returns slots, and what was sent to it is lost where this
        # end is closed before it has read them.
        while True:
            connection.recv_bytes()


def _serve(work: Work, shared: SharedFrames, connection: Connection) -> None:
    """Says that it is ready, and sends all frames."""
    extracts = (lambda: bool(shared.wanted[0])) if _is_shared_out(work, MIN_EXTRACTING) else None
    preparation = FramePreparation(work.dataset, work.config, work.start, extracts=extracts)
    # That takes tenths of a second; meanwhile the loop's process loads kernels.
    with _shared_out(work, preparation, connection) as source:
        connection.send(True)
        _send_frames(work, preparation, source, shared.slots, connection)


def _send_frames(
    work: Work,
    preparation: FramePreparation,
    source: Readable[PreparedFrame],
    memory: torch.Tensor,
    connection: Connection,
) -> None:
    free, before, number = deque(range(work.slots)), 0.0, work.processed
    frozen = FrozenFrames(work.dataset, work.start)
    with prefetch(source, work.workers, work.ahead) as frames:
        for item in frames:
            read_ms, before = 1e3 * (frames.read_seconds - before), frames.read_seconds
            frame = frozen.checked(item)
            if isinstance(frame, DatasetError):
                _send(connection, Message(read_ms, error=frame))
                continue
            preparation.extract_ahead(frame, number)
            number += 1
            slot, pixels = _free_slot(free, connection), cast(FramePixels, frame.pixels)
            memory[slot].copy_(pixels.buffer)
            _send(connection, Message.of(frame, read_ms, slot))
    _send(connection, Message())


def _is_shared_out(work: Work, least: int = 2) -> bool:
    """Whether processes prepare the frames, at least so many."""
    return work.workers >= least and work.dataset.is_random_access


@contextlib.contextmanager
def _shared_out(work: Work, preparation: FramePreparation, connection: Connection) -> Iterator[Readable[PreparedFrame]]:
    """The frames of a preparation, by a process for each thread where the data can be shared out."""
    if not _is_shared_out(work):
        yield preparation
        return
    blank = blank_pixels(work.dataset.camera, work.config)
    try:
        forked = ForkedPreparation(preparation, blank, work.workers, connection)
    except OSError:  # no more processes, or no memory for them: threads need neither
        yield preparation
        return
    with contextlib.closing(forked):
        forked.wait_until_ready()
        yield forked


def _send(connection: Connection, message: Message) -> None:
    """As a plain tuple, which the loop takes less time to read."""
    connection.send(tuple(message))


def _free_slot(free: deque[int], connection: Connection) -> int:
    while not free or connection.poll():
        free.append(_sent_slot(connection))
    return free.popleft()
