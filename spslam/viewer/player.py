"""What pause, step and the slider do: hold a live run, or move through a finished one."""

from __future__ import annotations

import threading
from collections.abc import Callable

import numpy as np

from spslam.viewer.protocol import Request

# A gap of the time stamps is not waited through.
_MAX_PAUSE_S = 1.0
# Where the time stamps are no seconds.
_MIN_PAUSE_S = 0.01


class Player:
    """Controls which frame is shown.

    Attributes:
        total: number of frames to move through; None where the newest is shown.
        can_pause: whether there is anything to pause and to step.
        is_playing: whether the run, or the replay, goes on.
    """

    total: int | None = None
    can_pause: bool = True
    is_playing: bool = True

    @property
    def label(self) -> str:
        """Text of the button that toggles."""
        return "Pause" if self.is_playing else "Continue"

    def toggle(self) -> None:
        """Pauses, or continues."""

    def step(self) -> None:
        """Pauses, one frame later."""

    def seek(self, frame: int) -> None:
        """Pauses at a frame."""


class LivePlayer(Player):
    """Holds a run between two frames.

    Args:
        send: passes a request to the run.
        can_pause: whether the run heeds it.
    """

    def __init__(self, send: Callable[[Request], None], can_pause: bool = True):
        self._send, self.can_pause = send, can_pause

    def toggle(self) -> None:
        self.is_playing = not self.is_playing
        self._send(Request(paused=not self.is_playing))

    def step(self) -> None:
        if self.is_playing:
            self.toggle()
        self._send(Request(step=True))


class ReplayPlayer(Player):
    """Moves through a finished run at the speed of its time stamps, until it is closed.

    Args:
        timestamps: float64 [F], s; F is at least 1.
        show: called with the number of the frame to show, from any thread.
    """

    def __init__(self, timestamps: np.ndarray, show: Callable[[int], None]):
        self.total, self.is_playing = len(timestamps), False
        self._pauses_s = np.clip(np.diff(timestamps), _MIN_PAUSE_S, _MAX_PAUSE_S)
        self._show, self._frame = show, len(timestamps) - 1
        self._lock, self._changed = threading.RLock(), threading.Event()
        self._has_ended = False
        self._thread = threading.Thread(target=self._play, name="spslam-viewer-play", daemon=True)
        self._thread.start()

    @property
    def label(self) -> str:
        return "Pause" if self.is_playing else "Play"

    def toggle(self) -> None:
        with self._lock:
            self.is_playing = not self.is_playing and not self._has_ended
            if self.is_playing and self._frame >= len(self._pauses_s):
                self._move(0)
        self._changed.set()

    def step(self) -> None:
        with self._lock:
            self.is_playing = False
            self._move(self._frame + 1)

    def seek(self, frame: int) -> None:
        with self._lock:
            self.is_playing = False
            self._move(frame)

    def close(self) -> None:
        """Ends the thread; nothing is shown any more. Must not be called from `show`. May be called again."""
        with self._lock:
            self._has_ended, self.is_playing = True, False
        self._changed.set()
        self._thread.join()

    def _move(self, frame: int) -> None:
        if self._has_ended:
            return
        self._frame = min(max(frame, 0), len(self._pauses_s))
        self._show(self._frame)

    def _play(self) -> None:
        while not self._has_ended:
            self._changed.wait()
            self._changed.clear()
            while self.is_playing and self._frame < len(self._pauses_s):
                if self._changed.wait(float(self._pauses_s[self._frame])):
                    self._changed.clear()  # paused, and perhaps playing again
                    continue
                with self._lock:
                    if self.is_playing:
                        self._move(self._frame + 1)
            with self._lock:
                if self._frame >= len(self._pauses_s) and self.is_playing:
                    self.is_playing = False
                    self._show(self._frame)
