"""The loop over a run's frames, with its log, checkpoints and clock."""

import contextlib
import json
import time
from collections import deque
from collections.abc import Callable
from typing import IO, Any

from spslam.errors import DatasetError
from spslam.run.checkpoint_writer import CheckpointWriter
from spslam.run.frame_feed import FrameFeed
from spslam.run.interruption import Interruption
from spslam.run.output_folder import RunFiles
from spslam.slam.frame_report import FrameReport, PendingReport
from spslam.slam.prepared_frame import PreparedFrame
from spslam.slam.system import SlamSystem

Progress = Callable[[int, int, FrameReport | None], None]


class RunLoop:
    """Gives the frames to the system, and tells of each when the device is done with it.

    Args:
        system: takes the frames.
        feed: has them, from the run's first or the checkpoint's next on.
        total: frames of the whole run.
        files: of the output folder.
        identity: JSON object that names the data, for checkpoints.
        clock: `wall_s`, `decode_s` and `frames` so far; kept up to date.
        progress: called with (frames done, frames in all, report of the frame; None for a skipped one).
    """

    def __init__(
        self,
        system: SlamSystem,
        feed: FrameFeed,
        total: int,
        files: RunFiles,
        identity: dict[str, Any],
        clock: dict[str, Any],
        progress: Progress | None,
    ):
        self.system, self.feed, self.total, self.files = system, feed, total, files
        self.identity, self.clock, self.progress = identity, clock, progress
        self._before, self._started, self._start = dict(clock), 0.0, 0
        self._pending: deque[tuple[int, PendingReport | None]] = deque()

    def run(self, start: int) -> None:
        """Processes the frames from position `start` on, and optimizes a last time.

        Raises:
            KeyboardInterrupt: after Ctrl-C, between two frames; with checkpoints, the last one is of all up to there.
        """
        self._start, self._started = start, time.perf_counter()
        threaded = self.system.device.type == "cuda"
        with (
            self.files.open_log() as log,
            Interruption() as interruption,
            contextlib.closing(CheckpointWriter(self.files.checkpoint, threaded)) as writer,
        ):
            try:
                self._process(log, writer, interruption)
            except Exception:
                # What was done before goes into the log, if the device still tells.
                with contextlib.suppress(Exception):
                    self._tell(log, wait=True)
                raise

    def _process(self, log: IO[str], writer: CheckpointWriter, interruption: Interruption) -> None:
        every, last_saved = self.system.config.run.checkpoint_every, self._start
        done = self._start
        for done, item in enumerate(self.feed, self._start + 1):
            self._pending.append((done, self._take(item, done - 1)))
            self._tell(log)
            self._keep_time(done)
            if interruption.noted:
                break
            if done < self.total and _is_checkpoint_due(every, last_saved, done) and not writer.is_busy:
                self._save(done, log, writer)
                last_saved = done
        if interruption.noted:
            if every > 0:
                self._save(done, log, writer)
            raise KeyboardInterrupt
        self.system.finish()
        self._tell(log, wait=True)
        self._keep_time(done)

    def _take(self, item: PreparedFrame | DatasetError, position: int) -> PendingReport | None:
        if isinstance(item, DatasetError):
            self.files.record_skipped(position, item)
            return None
        return self.system.submit(item)

    def _tell(self, log: IO[str], wait: bool = False) -> None:
        """Logs the frames that the device is done with, or waits for all of them."""
        while self._pending and (wait or self._pending[0][1] is None or self._pending[0][1].is_done()):
            done, pending = self._pending.popleft()
            report = pending.result() if pending else None
            if report:
                log.write(json.dumps(report.log_row()) + "\n")
            if self.progress:
                self.progress(done, self.total, report)

    def _keep_time(self, done: int) -> None:
        self.clock |= {
            "frames": self._before["frames"] + done - self._start,
            "wall_s": self._before["wall_s"] + time.perf_counter() - self._started,
            "decode_s": self._before["decode_s"] + self.feed.decode_seconds,
        }

    def _save(self, position: int, log: IO[str], writer: CheckpointWriter) -> None:
        self._tell(log, wait=True)
        source = {"data": self.identity, "next": position, "clock": dict(self.clock)}
        writer.write(self.system.state, self.system.config, source, log.fileno())


def _is_checkpoint_due(every: int, last_saved: int, done: int) -> bool:
    """Every so many frames, but as checkpoints grow with the frames, not before a tenth of them is new."""
    return every > 0 and done - last_saved >= max(every, done // 10)
