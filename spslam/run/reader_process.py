"""Frames prepared by the threads of another process, so that they and the loop need no turns at one interpreter.

Both processes map the same memory, divided into slots of one frame's pixels. The loop's end of a socket sends the work,
then the numbers of slots that are free again; the reader's end sends a message a frame. Either end notices by the
socket when the other is gone, however it went, and the memory goes with the last of them.
"""

import contextlib
import os
import pickle
import signal
import subprocess
from collections import deque
from collections.abc import Iterator
from dataclasses import replace
from multiprocessing.connection import Connection

import torch

from spslam.config import Config
from spslam.datasets.base import RgbdDataset
from spslam.errors import DatasetError, SpslamError
from spslam.run.reader_launch import launch, take_standby
from spslam.run.reader_service import GONE, Message, Work, mapped
from spslam.slam.pixels import FramePixels, blank_pixels
from spslam.slam.prepared_frame import PreparedFrame
from spslam.slam.upload import Upload, Uploader

_WORD_BYTES = 4
_LAST_WORDS_S = 5.0


class ReaderProcess(Iterator[PreparedFrame | DatasetError]):
    """The frames of a data set from a position on, in order, prepared by another process.

    Attributes:
        read_seconds: time spent on preparing the frames handed out, summed over the threads.
    """

    def __init__(
        self,
        process: subprocess.Popen,
        connection: Connection,
        memory: torch.Tensor,
        blank: FramePixels,
        uploader: Uploader | None,
    ):
        """See `start`.

        Args:
            process: that reads.
            connection: to it.
            memory: int32 [slots, words], mapped by both.
            blank: a frame's pixels without content.
            uploader: takes the pixels to a device; they are copied out of the slot where None.
        """
        self.read_seconds = 0.0
        self._process, self._connection = process, connection
        self._memory, self._blank, self._uploader = memory, blank, uploader
        self._in_use: deque[tuple[int, Upload]] = deque()
        self._begun = self._is_locked = False

    @classmethod
    def start(
        cls,
        dataset: RgbdDataset,
        config: Config,
        start: int,
        workers: int,
        ahead: int,
        uploader: Uploader | None,
    ) -> "ReaderProcess | None":
        """Starts the process; it reads nothing before the first frame is asked for.

        Args:
            dataset: the frames.
            config: how they are sampled.
            start: position of the first frame.
            workers: threads.
            ahead: most frames that exist at a time.
            uploader: see the class.

        Returns:
            None where it can't be done: the data set can't be pickled, or no process started.
        """
        slots = max(ahead // 2, 1)
        blank = blank_pixels(dataset.camera, config)
        words = len(blank.buffer)
        work = Work(dataset, config, start, workers, max(ahead - slots, 1), slots, words)
        try:
            content = pickle.dumps(work)
            reader = take_standby() or launch()
        except (pickle.PicklingError, AttributeError, TypeError, OSError):
            return None
        os.ftruncate(reader.shared, max(slots * words * _WORD_BYTES, 1))
        memory = mapped(reader.shared, slots, words)
        os.close(reader.shared)
        with contextlib.suppress(*GONE):
            reader.connection.send_bytes(content)
        return cls(reader.process, reader.connection, memory, blank, uploader)

    def is_ready(self) -> bool:
        """Waits until it can read. False where the data set means nothing to another process, which has then ended."""
        try:
            ready = self._connection.recv()
        except GONE:
            ready = False
        if not ready:
            self.close()
        elif self._uploader is not None:
            self._is_locked = self._uploader.lock_pages(self._memory)
        return ready

    def __next__(self) -> PreparedFrame | DatasetError:
        try:
            return self._receive()
        except GONE:
            with contextlib.suppress(subprocess.TimeoutExpired):
                self._process.wait(_LAST_WORDS_S)
            self.close()
            raise SpslamError(_epitaph(self._process.returncode)) from None
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        """Ends the process, which has nothing to save. May be called again."""
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
        if self._connection.closed:
            raise StopIteration
        if not self._begun:
            self._connection.send(None)
            self._begun = True
        self._return_slots()
        message: Message = self._connection.recv()
        if message.failure is not None:
            raise RuntimeError(f"reading frames failed:\n{message.failure}")
        self.read_seconds += message.read_ms / 1e3
        if message.error is not None:
            return message.error
        if message.slot is None:
            raise StopIteration
        pixels = self._taken(message.slot, message.valid_depth_share)
        return PreparedFrame(message.index, message.timestamp, pixels, message.decode_ms)

    def _taken(self, slot: int, valid_depth_share: float) -> FramePixels | Upload:
        """The pixels out of a slot, or on their way out of it."""
        pixels = replace(self._blank, buffer=self._memory[slot], valid_depth_share=valid_depth_share)
        if self._uploader is None:
            taken = pixels.holding(pixels.buffer.clone())
            self._connection.send(slot)
            return taken
        upload = self._uploader.send(pixels)
        self._in_use.append((slot, upload))
        return upload

    def _return_slots(self) -> None:
        """Gives back what was copied; waits where the reader would have no slot otherwise."""
        while self._in_use:
            slot, upload = self._in_use[0]
            if not upload.end.is_complete():
                if len(self._in_use) < len(self._memory):
                    return
                upload.end.wait()
            self._in_use.popleft()
            self._connection.send(slot)


def _epitaph(code: int | None) -> str:
    how = f"by {signal.Signals(-code).name}" if code is not None and code < 0 else f"with code {code}"
    return (
        f"the process that reads frames ended {how}; where memory was short, lower run.prefetch_ahead; "
        "run.reader=threads reads without it"
    )
