"""Frames prepared by processes that the reading process forks.

Threads of one process can't decode much more than 600 frames of 640x480 a second, however many cores there are: each of
some thirty calls per frame gives Python's global interpreter lock away and waits for it again. Here a thread only waits
for its process, and copies the pixels that it has left in memory that both map.
"""

import mmap
import multiprocessing
import traceback
from collections.abc import Sequence
from dataclasses import dataclass
from multiprocessing.connection import Connection
from multiprocessing.context import ForkProcess
from queue import SimpleQueue
from typing import cast

import torch

from spslam.errors import DatasetError
from spslam.helper_process import DISCONNECTED
from spslam.run.reader_message import Message
from spslam.slam.pixels import WORD_BYTES, FramePixels
from spslam.slam.prepared_frame import FramePreparation, PreparedFrame

_POSITION_BYTES = 8  # of a frame's position
_OWN_SLOT = 0  # each worker has memory for one frame
_READY = b"ready"


class WorkerEndedError(Exception):
    """A worker process has ended before its time.

    Attributes:
        code: of its exit; negative for a signal.
    """

    def __init__(self, code: int):
        super().__init__(f"a process that prepares frames ended with code {code}")
        self.code = code


@dataclass(frozen=True)
class _Worker:
    process: ForkProcess
    connection: Connection
    memory: torch.Tensor  # int32 [words] that both processes map

    def ended(self) -> WorkerEndedError:
        """What is to be raised once its connection is closed; waits for its end."""
        self.process.join()
        return WorkerEndedError(self.process.exitcode or 0)


class ForkedPreparation:
    """The frames of a preparation, by position, each prepared by one of several forked processes.

    May be asked from any thread; those that find all processes at work wait for one. The processes end when this is
    closed, or when the process ends that made it. That one must not have started threads before.

    Args:
        preparation: of a dataset that is `is_random_access`, without an uploader.
        blank: pixels of a frame without content, for the shapes.
        workers: number of processes, at least 1.
        inherited: a connection that they close, as it is the parent's.

    Raises:
        OSError: the system lets no more processes start; none is left.
    """

    def __init__(self, preparation: FramePreparation, blank: FramePixels, workers: int, inherited: Connection):
        self._length, self._blank = len(preparation), blank
        self._free: SimpleQueue[_Worker] = SimpleQueue()
        self._workers: list[_Worker] = []
        try:
            for _ in range(workers):
                inherited_ends = [inherited, *(worker.connection for worker in self._workers)]
                self._workers.append(_fork(preparation, len(blank.buffer), inherited_ends))
                self._free.put(self._workers[-1])
        except OSError:
            self.close()
            raise

    def wait_until_ready(self) -> None:
        """Waits until all processes are; none has to be waited for by a frame then.

        Raises:
            WorkerEndedError: a process has ended.
        """
        for worker in self._workers:
            try:
                worker.connection.recv_bytes()
            except DISCONNECTED:
                raise worker.ended() from None

    def __len__(self) -> int:
        return self._length

    def __getitem__(self, i: int) -> PreparedFrame:
        """Frame `i`, as the preparation makes it.

        Raises:
            DatasetError: the frame can't be read.
            WorkerEndedError: the process has ended that was to prepare it.
            RuntimeError: preparing it failed for another reason, with the traceback.
        """
        worker = self._free.get()
        try:
            worker.connection.send_bytes(i.to_bytes(_POSITION_BYTES, "little"))
            message = Message(*worker.connection.recv())
            if message.failure is not None:
                raise RuntimeError(message.failure)
            if message.error is not None:
                raise message.error
            return message.frame(message.pixels(self._blank, worker.memory.clone()))
        except DISCONNECTED:
            raise worker.ended() from None
        finally:
            self._free.put(worker)

    def close(self) -> None:
        """Ends the processes; nothing can be asked any more."""
        for worker in self._workers:
            worker.connection.close()


def _fork(preparation: FramePreparation, words: int, inherited: Sequence[Connection]) -> _Worker:
    context = multiprocessing.get_context("fork")
    own, other = context.Pipe()
    shared = mmap.mmap(-1, max(words, 1) * WORD_BYTES)  # anonymous, and shared with what is forked
    memory = torch.frombuffer(shared, dtype=torch.int32)[:words]
    process = context.Process(target=_work, args=(preparation, other, memory, (own, *inherited)), daemon=True)
    process.start()
    other.close()
    return _Worker(process, own, memory)


def _work(
    preparation: FramePreparation, connection: Connection, memory: torch.Tensor, inherited: Sequence[Connection]
) -> None:
    """What a worker does until its connection is closed."""
    # Else an end that is closed elsewhere stays open here, and nobody notices.
    for other in inherited:
        other.close()
    # A process that was forked gets its memory page by page: its first frame would take ten times as long as the next.
    # What is wrong with that one is said when it is asked for.
    _prepare(preparation, 0, memory)
    try:
        connection.send_bytes(_READY)
        while True:
            position = int.from_bytes(connection.recv_bytes(), "little")
            connection.send(tuple(_prepare(preparation, position, memory)))
    except DISCONNECTED:
        return


def _prepare(preparation: FramePreparation, position: int, memory: torch.Tensor) -> Message:
    try:
        frame = preparation[position]
        memory.copy_(cast(FramePixels, frame.pixels).buffer)
        return Message.of(frame, frame.decode_ms, _OWN_SLOT, frame.signature)
    except DatasetError as error:
        return Message(error=error)
    except Exception:
        return Message(failure=traceback.format_exc())
