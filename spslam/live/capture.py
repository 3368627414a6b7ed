"""The thread that takes frames from a camera: into the queue, and to the recorder."""

from __future__ import annotations

import contextlib
import threading
import time
from dataclasses import replace
from types import TracebackType

from spslam.datasets.base import RgbdFrame
from spslam.datasets.frame_arrays import check_frame, check_time
from spslam.errors import DatasetError, SourceError
from spslam.live.frame_queue import FrameQueue
from spslam.live.recorder import FolderRecorder
from spslam.live.source import LiveFrame, LiveSource

_END_S = 10.0  # for the source to yield once more after it was told to end
_END_AT_ONCE_S = 1.0  # after a second Ctrl-C


class Capture(contextlib.AbstractContextManager):
    """Iterates over a source's frames on a thread, from `with` until its end.

    Args:
        source: the camera; closed at the end.
        queue: receives the frames, numbered in the order in which they came; closed at the end.
        recorder: receives them too; None records nothing.

    Attributes:
        received: frames that came, with those that could not be used and those that the source left out.
        failure: what the source, or a check of its frames, raised.
    """

    def __init__(self, source: LiveSource, queue: FrameQueue, recorder: FolderRecorder | None = None) -> None:
        self.source, self.queue, self.recorder = source, queue, recorder
        self.failure: Exception | None = None
        self._count = 0
        self._ending, self._is_left_alone = threading.Event(), False
        self._thread = threading.Thread(target=self._run, name="spslam-capture", daemon=True)

    @property
    def received(self) -> int:
        return self._count + self.source.dropped

    def __enter__(self) -> Capture:
        self._thread.start()
        return self

    def stop(self) -> None:
        """Ends the thread and closes the source; waits until the source has yielded once more.

        May be called again; a source that did not end in time is not waited for a second time.
        """
        self._ending.set()
        if self._is_left_alone:
            return
        self._thread.join(_END_S)
        self._is_left_alone = self._thread.is_alive()
        if self._is_left_alone and self.failure is None:
            self.failure = SourceError(f"{self.source.name}: did not end within {_END_S:g} s; it is left alone")

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        if kind is not None and issubclass(kind, KeyboardInterrupt):
            self._ending.set()  # at once: a camera that does not answer is not waited for
            self._thread.join(_END_AT_ONCE_S)
        else:
            self.stop()

    def _run(self) -> None:
        try:
            for item in self.source.frames():
                if self._ending.is_set():
                    break
                if item is not None:
                    self._pass_on(item, time.monotonic())
        except Exception as error:
            self.failure = error
        finally:
            try:
                self.source.close()
            except Exception as error:
                self.failure = self.failure or error
            self.queue.close()

    def _pass_on(self, item: RgbdFrame | LiveFrame | DatasetError, now: float) -> None:
        self._count += 1
        if isinstance(item, DatasetError):
            self.queue.put(item)
            return
        arrived = item if isinstance(item, LiveFrame) else LiveFrame(item, now)
        frame = arrived.frame
        if not isinstance(frame, RgbdFrame):
            kinds = "RgbdFrame (RgbdFrame.from_arrays makes one), LiveFrame, DatasetError or None"
            raise TypeError(f"{self.source.name}: frames() must yield {kinds}, got {type(frame).__name__}")
        check_frame(self.source.name, frame.color, frame.depth, self.source.camera)
        check_time(self.source.name, frame.timestamp)
        # The source may write into its arrays again, while queue, recorder and previews keep the frame.
        number = self._count - 1 + self.source.dropped
        own = replace(frame, index=number, color=frame.color.copy(), depth=frame.depth.copy())
        numbered = LiveFrame(own, arrived.complete_s)
        if self.recorder is not None:
            self.recorder.offer(numbered.frame)
        self.queue.put(numbered)
