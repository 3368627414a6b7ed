"""What the viewer's process runs: receives a run's messages and shows them, and gives way to the run."""

from __future__ import annotations

import contextlib
import os
import resource
import signal
import socket
import threading
import time
from multiprocessing.connection import Connection
from typing import TYPE_CHECKING, cast

from spslam.viewer.options import Listener
from spslam.viewer.player import LivePlayer
from spslam.viewer.priority import give_way
from spslam.viewer.protocol import DISCONNECTED, Begin, MapSnapshot, Request, RunBegins, RunEnds, Update, receive

if TYPE_CHECKING:
    from spslam.viewer.live_session import LiveSession
    from spslam.viewer.model import RunModel
    from spslam.viewer.sink import Sink

# Where the run has ended or was killed, the process is ended after this time, whatever it is doing.
_EXIT_S = 4.0
_RECORDING_EXIT_S = 60.0
# Open files: connections beyond it are not accepted until others close.
_MAX_FILES = 512


def serve(descriptor: int) -> None:
    """Shows the run at the other end of a socket until it ends.

    Args:
        descriptor: of the socket.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the run, which then ends this process
    threading.excepthook = _end_with_thread
    _limit_files()
    connection = Connection(descriptor)
    with contextlib.suppress(*DISCONNECTED):
        begin = cast(Begin, receive(connection))
        service = _Service(connection, begin)
        try:
            service.run()
        finally:
            _end_after(_EXIT_S if begin.recording is None else _RECORDING_EXIT_S)
            service.close()


def _limit_files() -> None:
    """Few open files: what crowds of connections take."""
    with contextlib.suppress(OSError, ValueError):
        most = resource.getrlimit(resource.RLIMIT_NOFILE)[1]
        resource.setrlimit(resource.RLIMIT_NOFILE, (min(_MAX_FILES, most) if most > 0 else _MAX_FILES, most))


def _end_after(seconds: float) -> None:
    """Kills this process after a time: a thread that waits for a browser must not keep it, or its port."""

    def kill() -> None:
        time.sleep(seconds)
        os.kill(os.getpid(), signal.SIGKILL)

    threading.Thread(target=kill, daemon=True).start()


def _end_with_thread(args: threading.ExceptHookArgs) -> None:
    """A thread's failure ends the process, so that the run can say that its viewer has ended, and why."""
    threading.__excepthook__(args)
    os.kill(os.getpid(), signal.SIGTERM)


class _Service:
    """Passes messages on to the sinks.

    Args:
        connection: to the run.
        begin: what to open.
    """

    def __init__(self, connection: Connection, begin: Begin):
        self._connection, self._lock = connection, threading.Lock()
        self._sinks: list[Sink] = []
        self._session: LiveSession | None = None
        self._must_complete = begin.recording is not None
        if begin.listening is not None:
            from spslam.viewer.browser_sink import BrowserSink

            listening = socket.socket(fileno=begin.listening)
            listener = Listener(listening, begin.host, begin.token)
            self._sinks.append(BrowserSink(listener, begin.title, self._make_player))
        if begin.recording is not None:
            from spslam.viewer.rerun_sink import RerunSink

            self._sinks.append(RerunSink(begin.recording, begin.title))

    def run(self) -> None:
        """Until the run ends, or its process does."""
        # Loads torch, while the run does as well; the page is served already. With a low priority, beside a run that
        # leaves little of the processors, these two seconds of processor time would take half a minute.
        from spslam.viewer.live_session import LiveSession

        give_way()
        while True:
            message = receive(self._connection)
            match message:
                case RunBegins():
                    self._session = LiveSession(message, self._sinks, self._ask)
                    self._ask(Request(update=True, map=True))
                case Update() if self._session is not None:
                    self._session.update(message)
                case MapSnapshot() if self._session is not None:
                    self._session.update_map(message)
                case RunEnds():
                    if self._session is not None and self._must_complete:
                        self._session.complete()
                    return
            del message  # maps are large

    def close(self) -> None:
        """Closes the sinks."""
        for sink in self._sinks:
            sink.close()

    def _make_player(self, model: RunModel) -> LivePlayer:
        return LivePlayer(self._ask, model.info.can_pause)

    def _ask(self, request: Request) -> None:
        with self._lock, contextlib.suppress(*DISCONNECTED):
            self._connection.send_bytes(request.encode())
