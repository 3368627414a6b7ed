"""Progress display of a live run, whose length is not known."""

from __future__ import annotations

import contextlib
import shutil
import sys
import time
from typing import Any

from spslam.cli.progress import SECONDS_BETWEEN_LINES, describe

_SECONDS_BETWEEN_UPDATES = 0.2


def make_live_progress(quiet: bool) -> LiveProgress | None:
    """A callback for `run_live`; None if quiet."""
    return None if quiet else LiveProgress(sys.stderr.isatty())


class LiveProgress:
    """Frames, dropped frames, latency and the state of the last frame: on a terminal one line that is rewritten.

    Args:
        on_terminal: whether to rewrite the line; else a line is printed every few seconds.
    """

    def __init__(self, on_terminal: bool) -> None:
        self._on_terminal = on_terminal
        self._interval = _SECONDS_BETWEEN_UPDATES if on_terminal else SECONDS_BETWEEN_LINES
        self._last = self._started = time.monotonic()
        self._counted: tuple[float, int] | None = None
        self._open_line = self._was_ending = False

    def __call__(self, status: Any) -> None:
        now = time.monotonic()
        if self._counted is None:
            self._counted = self._last, 0
        if now - self._last < self._interval and not status.ending:
            return
        with contextlib.suppress(BrokenPipeError):  # whoever read this has gone, which is no reason to end
            self._show(self._line(status, now))
            if status.ending and not self._was_ending:
                self._was_ending = True
                self.close()
                print("ending: completing the map, writing the results", file=sys.stderr, flush=True)
        self._counted, self._last = (now, status.frames), now

    def close(self) -> None:
        """Ends the line on a terminal."""
        if self._open_line:
            print(file=sys.stderr, flush=True)
            self._open_line = False

    def _line(self, status: Any, now: float) -> str:
        since, counted = self._counted or (now, 0)
        rate = (status.frames - counted) / max(now - since, 1e-9)
        parts = [f"{status.frames} frames", f"{rate:.1f} frames/s", f"{status.dropped} dropped"]
        if len(status.latencies):
            parts.append(f"latency {status.latencies.last():.0f} ms (p99 {status.latencies.recent_p99():.0f})")
        if status.unrecorded:
            parts.append(f"{status.unrecorded} not recorded")
        return ", ".join([*parts, describe(status.report)])

    def _show(self, line: str) -> None:
        if not self._on_terminal:
            print(line, file=sys.stderr, flush=True)
            return
        columns = shutil.get_terminal_size().columns - 1
        print(f"\r{line[:columns]:<{columns}}", end="", file=sys.stderr, flush=True)
        self._open_line = True
