"""The run's side of the viewer: starts the viewer's process and feeds it, without waiting for it.

The frame loop only appends a row per frame and, when the viewer has asked for it, clones poses and map; a thread
converts and sends them. A viewer that stalls or ends costs the run nothing more.
"""

from __future__ import annotations

import contextlib
import math
import os
import queue
import subprocess
import sys
import tempfile
import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import replace
from multiprocessing import Pipe
from multiprocessing.connection import Connection
from types import TracebackType
from typing import IO

import cv2

from spslam.datasets.base import RgbdFrame
from spslam.run.observer import ObservedRun, RunObserver
from spslam.slam.frame_report import FrameReport
from spslam.slam.state import SlamState
from spslam.viewer.options import Listener, ViewerOptions, listen, require_rerun, require_viser
from spslam.viewer.protocol import DISCONNECTED, Begin, Message, Request, RunBegins, RunEnds, send, unfinished
from spslam.viewer.snapshots import MapClone, PoseClone, UpdateDraft

# What the process runs. By name, as it must not run in this one; a test checks that it exists.
SERVICE_MODULE, SERVICE_FUNCTION = "spslam.viewer.process", "serve"
MAX_UPDATES_PER_S = 5.0
# Rows that wait for a viewer that has stopped asking; it is then sent the newest ones.
MAX_PENDING_ROWS = 1 << 16
IMAGE_WIDTH_PX = 320
_POLL_S = 0.05
# The page has nothing to complete.
_EXIT_TIMEOUT_S = 1.0
# A recording is written to its end; after that the process is killed.
_RECORDING_TIMEOUT_S = 60.0
_TAIL_BYTES = 2000
_ENVIRONMENT = {
    "CUDA_VISIBLE_DEVICES": "",  # the map is shown by the CPU's kernels
    # Of glibc: else each of many threads keeps memory of its own, and large blocks that were freed stay.
    "MALLOC_ARENA_MAX": "2",
    "MALLOC_MMAP_THRESHOLD_": str(1 << 20),
    "OMP_NUM_THREADS": "1",
    "OPENBLAS_NUM_THREADS": "1",
}


class RunViewer(RunObserver, contextlib.AbstractContextManager):
    """Shows a run while it goes on: give it to `run_sequence` or `RunLoop`, or call its methods from another loop.

    Attributes:
        url: address to open in a browser; None where only a recording was asked for.
        has_token: whether the address carries a token.
    """

    def __init__(self, options: ViewerOptions, title: str, on_failure: Callable[[str], None] | None = None):
        """Use `open_viewer`."""
        listener = listen(options) if options.browser else None
        self.url = listener.url if listener else None
        self.has_token = listener is not None and listener.token is not None
        self._on_failure = on_failure or (lambda _: None)
        self._recording = options.recording
        self._gone, self._released, self._ending = threading.Event(), threading.Event(), False
        self._failed = threading.Lock()  # taken once, by the thread that notices that the viewer has ended
        self._paused, self._steps = False, 0
        self._wants_update, self._wants_map, self._next_update_s = False, False, 0.0
        self._pending: deque[tuple[FrameReport, float]] = deque(maxlen=MAX_PENDING_ROWS)
        self._state: SlamState | None = None
        self._drafted_s = time.perf_counter()
        self._outbox: queue.SimpleQueue[Message | UpdateDraft | MapClone | None] = queue.SimpleQueue()
        begin = Begin(title, None, "", None, options.recording)
        if listener is not None:
            begin = Begin(title, listener.token, listener.host, listener.socket.fileno(), options.recording)
        self._outbox.put(begin)
        self._process, self._connection, self._errors = _launch(listener)
        self._threads = [
            threading.Thread(target=target, name=f"spslam-viewer-{name}", daemon=True)
            for name, target in (("send", self._send), ("receive", self._receive))
        ]
        for thread in self._threads:
            thread.start()

    def begin(self, run: ObservedRun, state: SlamState) -> None:
        self._state = state
        scene = state.scene
        self._outbox.put(
            RunBegins(
                run.name,
                run.config,
                run.camera,
                run.total,
                run.data_dir,
                run.frames,
                run.can_read,
                run.can_pause,
                run.ground_truth,
                scene.settings,
                scene.seed,
            )
        )
        if run.log:
            self._outbox.put(UpdateDraft([], PoseClone.take(state, 0, state.frames.processed), log=run.log))

    def observe(self, report: FrameReport, frame: RgbdFrame | None = None) -> None:
        if self._gone.is_set() or self._state is None:
            self._pending.clear()
            return
        now = time.perf_counter()
        self._pending.append((report, now))
        if now < self._next_update_s:
            return
        if self._wants_update:
            self._wants_update, self._next_update_s = False, now + 1 / MAX_UPDATES_PER_S
            self._outbox.put(self._draft(self._state, frame))
        if self._wants_map and self._state.scene.volume.num_voxels:
            self._wants_map = False
            self._outbox.put(MapClone.take(self._state, report.frame + 1))

    def is_paused(self) -> bool:
        return self._paused and not self._gone.is_set()

    def wait(self, is_interrupted: Callable[[], bool]) -> float:
        began = time.perf_counter()
        while self.is_paused() and not is_interrupted():
            if self._steps > 0:
                self._steps -= 1
                break
            if self._wants_update and self._pending and self._state is not None:
                # The frame that the run stopped at.
                self._wants_update = False
                self._outbox.put(self._draft(self._state, None))
            self._released.wait(_POLL_S)
            self._released.clear()
        self._drafted_s = time.perf_counter()
        return self._drafted_s - began

    def finish(self) -> None:
        if self._state is None or self._gone.is_set():
            return
        if self._pending:
            self._outbox.put(self._draft(self._state, None))
        if self._state.scene.volume.num_voxels:
            self._outbox.put(MapClone.take(self._state, self._state.frames.processed))

    def close(self) -> None:
        """Ends the viewer's process; a recording is completed before. May be called again."""
        if self._ending:
            return
        self._ending = True
        self._paused = False
        self._outbox.put(RunEnds())
        self._outbox.put(None)
        timeout = _EXIT_TIMEOUT_S if self._recording is None else _RECORDING_TIMEOUT_S
        deadline = time.monotonic() + timeout
        self._threads[0].join(timeout)
        try:
            if self._process.wait(max(deadline - time.monotonic(), 0.1)) and not self._gone.is_set():
                self._on_failure(self._describe_exit())
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
            if self._recording is not None:
                self._on_failure(f"the recording was not completed within {timeout:.0f} s")
        if self._recording is not None:
            with contextlib.suppress(OSError):  # where it was not completed
                unfinished(self._recording, self._process.pid).unlink(missing_ok=True)
        self._gone.set()
        for thread in self._threads:
            thread.join(_EXIT_TIMEOUT_S)  # the socket's other end is closed
        self._connection.close()
        self._errors.close()

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self.close()

    def _draft(self, state: SlamState, frame: RgbdFrame | None) -> UpdateDraft:
        reports = [self._pending.popleft() for _ in range(len(self._pending))]
        spent_s, self._drafted_s = reports[-1][1] - self._drafted_s, reports[-1][1]
        rows = [report for report, _ in reports]
        # Frames that were finished before a pause ended, and are shown after it, say nothing of the speed.
        rate = len(rows) / spent_s if spent_s > 0 else math.nan
        draft = UpdateDraft(rows, PoseClone.take(state, rows[0].frame, rows[-1].frame + 1), rate)
        if frame is None:
            return draft
        height, width = frame.depth.shape
        size = min(IMAGE_WIDTH_PX, width), max(round(height * min(IMAGE_WIDTH_PX, width) / width), 1)
        color = cv2.resize(frame.color, size, interpolation=cv2.INTER_AREA)
        return replace(draft, color=color, depth=cv2.resize(frame.depth, size, interpolation=cv2.INTER_NEAREST))

    def _send(self) -> None:
        """Sends what is in the outbox, until None is; the socket's own buffer holds back a viewer that stalls."""
        while (item := self._outbox.get()) is not None:
            if self._gone.is_set():
                continue
            message = item.message() if isinstance(item, (UpdateDraft, MapClone)) else item
            try:
                send(self._connection, message)
            except DISCONNECTED:
                self._fail()

    def _receive(self) -> None:
        try:
            while True:
                request = Request.decode(self._connection.recv_bytes())
                self._wants_update |= request.update
                self._wants_map |= request.map
                if request.paused is not None:
                    self._paused, self._steps = request.paused, 0
                if request.step:
                    self._steps += 1
                self._released.set()
        except DISCONNECTED:
            self._fail()

    def _fail(self) -> None:
        """The viewer has ended: the run goes on without it."""
        if self._ending or not self._failed.acquire(blocking=False):
            return  # the other thread has noticed
        self._gone.set()
        self._released.set()
        with contextlib.suppress(subprocess.TimeoutExpired):
            self._process.wait(_EXIT_TIMEOUT_S)
        self._on_failure(self._describe_exit() + "; the run goes on without it")

    def _describe_exit(self) -> str:
        size = self._errors.seek(0, os.SEEK_END)
        self._errors.seek(max(size - _TAIL_BYTES, 0))
        lines = self._errors.read().decode(errors="replace").strip().splitlines()
        return f"the viewer ended with code {self._process.returncode}" + (f": {lines[-1]}" if lines else "")


def open_viewer(
    options: ViewerOptions, title: str = "spslam", on_failure: Callable[[str], None] | None = None
) -> RunViewer:
    """Opens a viewer for a run that is about to begin.

    Args:
        options: where to listen, and what to record.
        title: of the page.
        on_failure: called with one line where the viewer ends before the run; from any thread.

    Returns:
        The viewer, to be given to `run_sequence` or `RunLoop` as observer; use it as a context manager, which ends it.

    Raises:
        ViewerError: a package is missing, or the address can't be listened on.

    Example:
        >>> with open_viewer(ViewerOptions(port=0)) as viewer:  # doctest: +SKIP
        ...     run_sequence(request, observer=viewer)
    """
    if options.browser:
        require_viser()
    if options.recording is not None:
        require_rerun()
    return RunViewer(options, title, on_failure)


def _launch(listener: Listener | None) -> tuple[subprocess.Popen, Connection, IO[bytes]]:
    """Starts the process; it shares this one's session, as the scheduler weighs sessions against each other."""
    own, other = Pipe()
    errors = tempfile.TemporaryFile()  # noqa: SIM115 closed by RunViewer
    # At its end nothing is left to do, and threads that still work must not delay it.
    code = f"import os; from {SERVICE_MODULE} import {SERVICE_FUNCTION} as run; run({other.fileno()}); os._exit(0)"
    descriptors = (other.fileno(), *([listener.socket.fileno()] if listener else []))
    try:
        process = subprocess.Popen(
            [sys.executable, "-c", code],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=errors,
            pass_fds=descriptors,
            # What can be imported here can be imported there.
            env={**os.environ, **_ENVIRONMENT, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))},
        )
    except BaseException:
        own.close()
        errors.close()
        raise
    finally:
        other.close()
        if listener is not None:
            listener.socket.close()  # it is the process's now
    return process, own, errors
