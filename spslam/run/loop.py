"""The frame loop of a run: frames go to the SLAM system, reports to the log, the state to checkpoints."""

import contextlib
import functools
import time
from collections import deque
from collections.abc import Callable

import numpy as np

from spslam.errors import DatasetError
from spslam.run.checkpoint_writer import CheckpointWriter
from spslam.run.frame_feed import FrameFeed
from spslam.run.interruption import Interruption
from spslam.run.observer import RunObserver
from spslam.run.output_folder import RunLog
from spslam.run.session import RunSession
from spslam.slam.frame_report import FrameReport, PendingReport
from spslam.slam.prepared_frame import PreparedFrame
from spslam.slam.system import SlamSystem

Progress = Callable[[int, int, FrameReport | None], None]


# A GPU's fast frames are logged so many at a time, or all after so many seconds: one by one, between other work, each
# would take twice the time. That is done while the next frame is tracked; where none is, after twice as many seconds,
# or while the next one is waited for.
LOGGED_TOGETHER = 16
LOGGED_WITHIN_S = 0.05


class RunLoop:
    """Processes the frames of a session and reports each one when the device has finished it.

    Args:
        system: processes the frames.
        feed: provides them, from `session.start` on.
        session: of the run; its clock is kept up to date.
        progress: called after each frame with (frames done, total frames, report of the frame or None if the frame
            could not be read).
        observer: watches the run and may pause it between two frames.
        first_poses: float64 [N, 4, 4] by the frames' index, where the map begins; NaN where that is not known. None
            where it begins at the system's first pose.
    """

    def __init__(
        self,
        system: SlamSystem,
        feed: FrameFeed,
        session: RunSession,
        progress: Progress | None,
        observer: RunObserver | None = None,
        first_poses: np.ndarray | None = None,
    ):
        self.system, self.feed, self.session, self.progress = system, feed, session, progress
        self.first_poses = first_poses
        self.observer = observer or RunObserver()
        self._pending: deque[tuple[int, PendingReport | None]] = deque()
        self._logs_meanwhile, self._logged = False, 0.0

    def run(self) -> None:
        """Processes all frames, then runs the last optimization.

        Raises:
            KeyboardInterrupt: after Ctrl-C, between two frames. With checkpoints enabled, the last one then holds all
                frames processed so far.
        """
        self.session.clock.start_loop()
        threaded = self.system.device.type == "cuda"
        with (
            RunLog(self.session.folder.log) as log,
            Interruption() as interruption,
            contextlib.closing(CheckpointWriter(self.session.folder.checkpoint, threaded)) as writer,
        ):
            try:
                self._process(log, writer, interruption)
            except Exception:
                # Log the frames finished before the failure, if the device still answers.
                with contextlib.suppress(Exception):
                    self._flush_reports(log, wait=True)
                raise
            finally:
                self.system.while_tracking = None

    def _process(self, log: RunLog, writer: CheckpointWriter, interruption: Interruption) -> None:
        self.system.while_tracking = functools.partial(self._work_ahead, log)
        self._logs_meanwhile = self.system.device.type == "cuda"
        every = self.system.config.run.checkpoint_every
        done = last_saved = self.session.start
        for done, item in enumerate(self.feed, self.session.start + 1):
            self._pending.append((done, self._submit(item, done - 1)))
            if not self._logs_meanwhile or self._is_log_due(2 * LOGGED_WITHIN_S) or not self.feed.is_ready:
                self._flush_reports(log)
            self._update_clock(done)
            if interruption.requested:
                break
            if done < self.session.total and _is_checkpoint_due(every, last_saved, done) and not writer.is_busy:
                self._save(done, log, writer)
                last_saved = done
            self._wait_while_paused(log, interruption)
            if interruption.requested:
                break
        if interruption.requested:
            self._flush_reports(log, wait=True)
            if every > 0:
                self._save(done, log, writer)
            raise KeyboardInterrupt
        self.system.finish()
        self._flush_reports(log, wait=True)
        self._update_clock(done)
        self.observer.finish()
        if interruption.requested:  # while the map was completed, which has no checkpoint of its own
            raise KeyboardInterrupt

    def _wait_while_paused(self, log: RunLog, interruption: Interruption) -> None:
        """Waits where the observer wants it; that time is not the run's."""
        if self.observer.is_paused():
            self._flush_reports(log, wait=True)
            self.session.clock.leave_out(self.observer.wait(lambda: interruption.requested))

    def _submit(self, item: PreparedFrame | DatasetError, position: int) -> PendingReport | None:
        if isinstance(item, DatasetError):
            self.session.folder.record_skipped(position, item)
            return None
        if self.first_poses is not None:
            self.system.begin_at(self.first_poses[item.index])
        pending = self.system.submit(item)
        self.feed.want_features(self.system.features.are_expected)
        return pending

    def _work_ahead(self, log: RunLog) -> None:
        """What the host does while the device tracks a frame, instead of having it wait later."""
        if self._is_log_due(LOGGED_WITHIN_S):
            self._flush_reports(log)
        self.feed.look_ahead()

    def _is_log_due(self, seconds: float) -> bool:
        """Whether so many frames wait to be logged, or have waited for so long, that they are now."""
        return len(self._pending) > LOGGED_TOGETHER or time.perf_counter() - self._logged > seconds

    def _flush_reports(self, log: RunLog, wait: bool = False) -> None:
        """Logs the frames that the device has finished; with `wait`, waits for all of them."""
        self._logged = time.perf_counter()
        reports: list[tuple[int, FrameReport | None]] = []
        try:
            while self._pending and (wait or self._pending[0][1] is None or self._pending[0][1].is_done()):
                done, pending = self._pending.popleft()
                reports.append((done, pending.result() if pending else None))
        finally:
            log.append([report.log_row() for _, report in reports if report])
        for done, report in reports:
            if report:
                self.observer.observe(report)
            if self.progress:
                self.progress(done, self.session.total, report)

    def _update_clock(self, done: int) -> None:
        self.session.clock.update(done - self.session.start, self.feed.decode_seconds)

    def _save(self, position: int, log: RunLog, writer: CheckpointWriter) -> None:
        self._flush_reports(log, wait=True)
        source = {"data": self.session.identity, "next": position, "clock": self.session.clock.to_dict()}
        writer.write(self.system.state, self.system.config, source, log.sync)


def _is_checkpoint_due(every: int, last_saved: int, done: int) -> bool:
    """Whether `every` frames are new and, as checkpoints grow with the frames, also a tenth of all frames."""
    return every > 0 and done - last_saved >= max(every, done // 10)
