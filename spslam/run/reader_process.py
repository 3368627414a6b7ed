"""Frames prepared by the threads of another process, so that they don't compete with the frame loop for Python's GIL.

Both processes map the same memory, divided into slots that hold one frame's pixels each. Over a socket the loop sends
the work and then the numbers of slots that are free again; the reader says that it is ready and sends one message per
frame. Either side detects by the closed socket that the other has ended, for whatever reason; the system frees the
memory with the last of them.
"""

import contextlib
import os
import pickle
import select
import subprocess
from collections import deque
from collections.abc import Iterator
from multiprocessing.connection import Connection

from spslam.config import Config
from spslam.datasets.base import RgbdDataset
from spslam.errors import DatasetError, SpslamError, brief
from spslam.helper_process import DISCONNECTED, NOT_STARTED, describe_exit
from spslam.run.reader_launch import AHEAD_PER_WORKER, READERS
from spslam.run.reader_message import Message
from spslam.run.reader_service import SharedFrames, Work, slot_message
from spslam.slam.pixels import FramePixels, blank_pixels
from spslam.slam.prepared_frame import PreparedFrame
from spslam.slam.upload import Upload, Uploader

_EXIT_TIMEOUT_S = 5.0


class ReaderUnavailableError(SpslamError):
    """No separate process can read the dataset."""


class ReaderProcess(Iterator[PreparedFrame | DatasetError]):
    """The frames of a dataset from a position on, in order, prepared by another process.

    Attributes:
        read_seconds: time spent on preparing the frames handed out, summed over the threads.
    """

    def __init__(
        self,
        process: subprocess.Popen,
        connection: Connection,
        shared: SharedFrames,
        blank: FramePixels,
        uploader: Uploader | None,
        kind: type[RgbdDataset],
    ):
        """Use `start`.

        Args:
            process: the reading process.
            connection: socket to the process.
            shared: memory that both map.
            blank: pixels of a frame without content, for the shapes.
            uploader: copies the pixels to a device; if None, they are copied out of the slot on the host.
            kind: the dataset's class, for messages.
        """
        self.read_seconds = 0.0
        self._process, self._connection = process, connection
        self._memory, self._wanted = shared
        self._blank, self._uploader, self._kind = blank, uploader, kind
        self._in_use: deque[tuple[int, Upload]] = deque()
        self._has_ended = self._is_locked = False
        # Each frame asks; `Connection.poll` would make another one each time.
        self._poll = select.poll()
        self._poll.register(connection.fileno(), select.POLLIN)

    @classmethod
    def start(
        cls,
        dataset: RgbdDataset,
        config: Config,
        begin: tuple[int, int],
        workers: int,
        ahead: int,
        uploader: Uploader | None,
    ) -> "ReaderProcess":
        """Starts the process, or takes the standby reader. It reads the first frames at once, with image features,
        while the loop's process loads kernels.

        Args:
            dataset: the frames.
            config: how they are sampled.
            begin: position of the first frame, and how many were processed before it.
            workers: number of reading threads.
            ahead: maximum number of frames that exist at the same time.
            uploader: copies the pixels to a device; None for the CPU.

        Raises:
            ReaderUnavailableError: the dataset can't be pickled, or the process can't be started.
        """
        slots = max(ahead // AHEAD_PER_WORKER, 1)
        blank = blank_pixels(dataset.camera, config)
        words = len(blank.buffer)
        start, processed = begin
        work = Work(dataset, config, start, workers, max(ahead - slots, 1), slots, words, processed)
        try:
            content = pickle.dumps(work)
        except (pickle.PicklingError, AttributeError, TypeError) as error:
            raise _unavailable(f"{dataset.name} can't be pickled ({brief(str(error))})") from error
        try:
            reader = READERS.take()
        except NOT_STARTED as error:
            raise _unavailable(f"the process can't be started ({brief(str(error))})") from error
        os.ftruncate(reader.shared, SharedFrames.size(slots, words))
        shared = SharedFrames.mapped(reader.shared, slots, words)
        os.close(reader.shared)
        shared.wanted[0] = True
        with contextlib.suppress(*DISCONNECTED):
            reader.connection.send_bytes(content)
        return cls(reader.process, reader.connection, shared, blank, uploader, type(dataset))

    def wait_until_ready(self) -> None:
        """Waits until the process can read.

        Raises:
            ReaderUnavailableError: the dataset's class can't be imported by the process, which has then ended, or it
                ended before it could read.
            RuntimeError: it can't begin for another reason, with the traceback.
        """
        try:
            ready = self._connection.recv()
        except DISCONNECTED:
            code = self._exit_code()
            self.close()
            raise _unavailable(f"the process ended {describe_exit(code)} before it could read") from None
        if isinstance(ready, tuple):
            self.close()
            _check_failure(Message(*ready))
        if not ready:
            self.close()
            name = f"{self._kind.__module__}.{self._kind.__qualname__}"
            raise _unavailable(f"{name} can't be imported by another process")
        if self._uploader is not None:
            self._is_locked = self._uploader.lock_pages(self._memory)

    def want_features(self, wanted: bool) -> None:
        """Says whether image features of frames that are read from now on will probably be asked for."""
        self._wanted[0] = wanted

    @property
    def slots(self) -> int:
        """How many frames the shared memory holds; one's slot is free again once another is taken after its upload."""
        return len(self._memory)

    def is_ready(self) -> bool:
        """Whether the next frame, or what there is instead, is there; to be asked after `wait_until_ready`."""
        return not self._has_ended and not self._connection.closed and bool(self._poll.poll(0))

    def __next__(self) -> PreparedFrame | DatasetError:
        try:
            return self._receive()
        except DISCONNECTED:
            code = self._exit_code()
            self.close()
            raise SpslamError(_describe_exit(code)) from None
        except StopIteration:  # closing takes as long as some ten frames: the run waits for it after the last one
            self._has_ended = True
            raise
        except BaseException:
            self.close()
            raise

    def _exit_code(self) -> int | None:
        """That of the process, which has ended its connection; None where it goes on without."""
        with contextlib.suppress(subprocess.TimeoutExpired):
            self._process.wait(_EXIT_TIMEOUT_S)
        return self._process.returncode

    def close(self) -> None:
        """Kills the process, which has nothing to save. May be called again."""
        if self._connection.closed:
            return
        self._connection.close()
        self._process.kill()
        self._process.wait()
        while self._in_use:
            self._in_use.popleft()[1].end.wait()
        if self._uploader is not None and self._is_locked:
            self._uploader.unlock_pages(self._memory)

    def _receive(self) -> PreparedFrame | DatasetError:
        if self._has_ended or self._connection.closed:
            raise StopIteration
        self._return_slots()
        message = Message(*self._connection.recv())
        _check_failure(message)
        self.read_seconds += message.read_ms / 1e3
        if message.error is not None:
            return message.error
        if message.slot is None:
            raise StopIteration
        return message.frame(self._take(message.slot, message))

    def _take(self, slot: int, message: Message) -> FramePixels | Upload:
        """A copy of the pixels in a slot, or their upload."""
        pixels = message.pixels(self._blank, self._memory[slot])
        if self._uploader is None:
            copy = pixels.holding(pixels.buffer.clone())
            self._connection.send_bytes(slot_message(slot))
            return copy
        upload = self._uploader.send(pixels)
        self._in_use.append((slot, upload))
        return upload

    def _return_slots(self) -> None:
        """Frees the slots whose upload is complete; waits for one where the reader has no slot left."""
        while self._in_use:
            slot, upload = self._in_use[0]
            if not upload.end.is_complete():
                if len(self._in_use) < len(self._memory):
                    return
                upload.end.wait()
            self._in_use.popleft()
            self._connection.send_bytes(slot_message(slot))


def _check_failure(message: Message) -> None:
    """Raises what the process says has failed in it, apart from a frame that can't be read."""
    if message.ended is not None:
        raise SpslamError(_describe_exit(message.ended))
    if message.failure is not None:
        raise RuntimeError(f"reading frames failed:\n{message.failure}")


def _unavailable(reason: str) -> ReaderUnavailableError:
    return ReaderUnavailableError(
        f"run.reader=process can't be used: {reason}; run.reader=threads uses no separate process"
    )


def _describe_exit(code: int | None) -> str:
    return (
        f"the process that reads frames ended {describe_exit(code)}; if memory was short, lower run.prefetch_ahead; "
        "run.reader=threads uses no separate process"
    )
