"""The loop of a live run: the newest frame first, the optimization of the map in between."""

from __future__ import annotations

import contextlib
import math
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from spslam.datasets.base import clear_border, clear_left_out
from spslam.datasets.frozen_depth import FROZEN, ArrivingFrozenDepth
from spslam.datasets.mask import left_out_by
from spslam.errors import DatasetError
from spslam.live.capture import Capture
from spslam.live.frame_queue import FrameQueue
from spslam.live.latency import Latencies
from spslam.live.previews import PreviewStore
from spslam.live.source import LiveFrame
from spslam.run.clock import RunClock
from spslam.run.device import explained_failures
from spslam.run.interruption import Interruption
from spslam.run.observer import RunObserver
from spslam.run.output_folder import OutputFolder, RunLog
from spslam.slam.device_events import event_recorder
from spslam.slam.frame_report import FrameReport
from spslam.slam.prepared_frame import PreparedFrame
from spslam.slam.system import SlamSystem

_POLL_S = 0.1  # between two looks for Ctrl-C while no frame comes
# Of a frame's share of a mapping call, what is made while the next frame waits already: a frame that is dropped costs
# more than iterations that a known surface hardly needs.
LEAST_SHARE = 0.5


@dataclass
class LiveStatus:
    """Where a live run stands; what a progress display shows.

    Attributes:
        frames: tracked so far.
        skipped: frames that could not be used.
        dropped: frames dropped because they came too late, by the queue or the source.
        received: tracked, skipped and dropped frames together; known at the end.
        latencies: from complete images to a known pose.
        unrecorded: frames that the recorder left out.
        report: of the last frame; None before the first, and where the last could not be used.
        ending: whether the camera is no longer listened to, and results are being written.
    """

    frames: int = 0
    skipped: int = 0
    dropped: int = 0
    received: int = 0
    latencies: Latencies = field(default_factory=Latencies)
    unrecorded: int = 0
    report: FrameReport | None = None
    ending: bool = False


LiveProgress = Callable[[LiveStatus], None]


@dataclass
class _Row:
    """A line of log.jsonl in the making: mapping goes on after the frame until the next one comes."""

    report: FrameReport
    live: dict[str, Any]
    mapping_iterations: int = 0
    mapping_ms: float = 0.0
    loss: float | None = None

    def values(self) -> dict[str, Any]:
        made = {name: getattr(self, name) for name in ("mapping_iterations", "mapping_ms", "loss")}
        return replace(self.report, **made).log_row() | self.live


class LiveLoop:
    """Tracks frames as they come, and optimizes the map while none waits.

    A frame's share of a mapping call is `mapping.iterations` / `mapping.every` iterations. At least `LEAST_SHARE` of it
    is made after each frame, so that the map follows on a slow machine too: there frames are dropped, rather than the
    map left behind.

    Args:
        system: processes the frames.
        capture: provides them through its queue.
        folder: of the run; the log is written there.
        clock: kept up to date.
        progress: called after each frame, and when the end begins.
        observer: watches the run; it is not asked to pause.
        begins_at_truth: whether the map begins at the ground-truth pose of its first frame, where that has one.

    Attributes:
        status: where the run stands.
        previews: frames for the report.
        poses: ground truth of the frames tracked, float64 [4, 4] each, or None; one more where a frame could not be.
        failure: why the loop ended early: the system could not go on, or what it calls has raised.
    """

    def __init__(
        self,
        system: SlamSystem,
        capture: Capture,
        folder: OutputFolder,
        clock: RunClock,
        progress: LiveProgress | None,
        observer: RunObserver | None = None,
        begins_at_truth: bool = False,
    ) -> None:
        self.observer = observer or RunObserver()
        self.system, self.capture, self.folder, self.clock = system, capture, folder, clock
        self.status = LiveStatus()
        self.previews = PreviewStore(system.config.run.previews)
        self.poses: list[np.ndarray | None] = []
        self.failure: Exception | None = None
        self._queue: FrameQueue = capture.queue
        self._progress = progress
        self._frozen_depth = ArrivingFrozenDepth()
        self._left_out = left_out_by(system.config.dataset.mask, system.camera)
        self._begins_at_truth = begins_at_truth
        self._record = event_recorder(system.device)
        mapping = system.config.mapping
        self._least = math.ceil(LEAST_SHARE * mapping.iterations / mapping.every)
        self._row: _Row | None = None
        self._next_index = 0  # of the frame that comes next if none is dropped

    def run(self, interruption: Interruption, seconds: float | None = None) -> None:
        """Processes frames until the source ends, until an interruption is requested, or after so many seconds."""
        self.clock.start_loop()
        deadline = time.monotonic() + (float("inf") if seconds is None else seconds)
        with RunLog(self.folder.log) as log:
            with self._failures_kept():
                while not (interruption.requested or self._queue.is_over or time.monotonic() > deadline):
                    self._take(log)
                    while self.system.mapping_left and not len(self._queue) and not interruption.requested:
                        self._map(1)
            self._end(log)

    @contextlib.contextmanager
    def _failures_kept(self) -> Iterator[None]:
        """Notes what fails, be it a limit that is reached: what there is up to there can't be made again."""
        try:
            with explained_failures(self.system.device):
                yield
        except Exception as error:
            self.failure = self.failure or error

    def _take(self, log: RunLog) -> None:
        """Processes the next frame, if one comes within a moment."""
        requested, began = self._record(), time.perf_counter()
        item = self._queue.take(_POLL_S)
        if item is not None:
            self._process(item, requested, 1e3 * (time.perf_counter() - began), log)
            self._map(self._least)

    def _process(self, item: LiveFrame | DatasetError, requested: Any, wait_ms: float, log: RunLog) -> None:
        status = self.status
        status.dropped = self._dropped()
        if isinstance(item, DatasetError):
            self._skip(item)
        elif self._frozen_depth.check(item.frame):
            self._skip(DatasetError(f"{self.capture.source.name}, frame {item.frame.index}: {FROZEN}"))
        else:
            queue_ms = 1e3 * (time.monotonic() - item.complete_s)
            self._submit(item, self._prepare(item, requested, wait_ms), queue_ms, log)
        self.clock.update(status.frames + status.skipped, self.clock.decode_s)
        self._tell()

    def _skip(self, error: DatasetError) -> None:
        """Records a frame that can't be used."""
        status = self.status
        self.folder.record_skipped(self.system.state.frames.processed + status.skipped, error)
        status.skipped += 1
        self._next_index += 1
        status.report = None

    def _submit(self, item: LiveFrame, frame: PreparedFrame, queue_ms: float, log: RunLog) -> None:
        """Tracks a frame; what need not be done before its pose is known is done then."""
        status = self.status
        known: list[float] = []
        truth = item.frame.pose
        self.poses.append(truth)
        if self._begins_at_truth and truth is not None:
            self.system.begin_at(truth)
        pending = self.system.submit(frame, lambda pose: known.append(time.monotonic()), defer_mapping=True)
        latency_ms = 1e3 * (known[0] - item.complete_s)
        self._frozen_depth.keep(item.frame)
        self._write_row(log)  # of the frame before, whose mapping has ended; the pose does not wait for it
        status.report = pending.result()
        status.latencies.add(latency_ms)
        # By its number: the source may be ahead, and have left out frames that come after this one.
        dropped, self._next_index = frame.index - self._next_index, frame.index + 1
        self._row = _Row(status.report, {"latency_ms": latency_ms, "queue_ms": queue_ms, "dropped": dropped})
        self.previews.add(status.frames, item.frame)
        status.frames += 1
        self.observer.observe(status.report, item.frame)

    def _prepare(self, item: LiveFrame, requested: Any, wait_ms: float) -> PreparedFrame:
        began, system, frame = time.perf_counter(), self.system, item.frame
        border_px = system.config.dataset.border_px
        if border_px > 0 or self._left_out is not None:  # the recorder may still need the frame as it is
            frame = replace(frame, depth=frame.depth.copy())
            clear_border(frame.depth, border_px)
            clear_left_out(frame.depth, self._left_out)
        prepared = system.prepare(frame)
        prepared.decode_ms = 1e3 * (time.perf_counter() - began)
        self.clock.decode_s += prepared.decode_ms / 1e3
        prepared.wait_ms, prepared.requested = wait_ms, requested
        return prepared

    def _map(self, iterations: int) -> None:
        """A part of the optimization of the map; returns when the device has done it."""
        began = self._record()
        made = self.system.optimize_map(iterations)
        if made and self._row is not None:
            ended = self._record()
            ended.wait()
            self._row.mapping_iterations += made
            self._row.mapping_ms += ended.ms_since(began)
            self._row.loss = None if self.system.mapping_loss is None else float(self.system.mapping_loss)

    def _write_row(self, log: RunLog) -> None:
        if self._row is not None:
            log.append([self._row.values()])
            self._row = None

    def _dropped(self) -> int:
        return self._queue.dropped + self.capture.source.dropped

    def _tell(self) -> None:
        if self.capture.recorder is not None:
            self.status.unrecorded = self.capture.recorder.left_out
        if self._progress is not None:
            self._progress(self.status)

    def _end(self, log: RunLog) -> None:
        """Ends the camera, and completes map and log."""
        self.capture.stop()
        self.status.ending = True
        self.status.dropped = self._dropped()
        self.status.received = self.capture.received - len(self._queue)
        with self._failures_kept():
            self._tell()
            if self.failure is None:
                self._map(self.system.mapping_left)
                self.system.finish()
        with self._failures_kept():
            self._write_row(log)
            self.observer.finish()
        self.clock.update(self.status.frames + self.status.skipped, self.clock.decode_s)
