"""A recording played back as if its camera were live: at its own pace, whether or not anyone keeps up."""

from __future__ import annotations

import time
from collections.abc import Iterator

import numpy as np

from spslam.datasets.base import RgbdDataset, RgbdFrame
from spslam.datasets.clock import CaptureOffsets
from spslam.datasets.prefetch import prefetch
from spslam.errors import DatasetError
from spslam.live.source import LiveFrame, LiveSource

READERS = 2  # threads
AHEAD = 6  # frames decoded before they are due
LATE_S = 0.2  # a frame that is not even decoded so long after it was due is not decoded any more
_NAP_S = 0.5


class ReplaySource(LiveSource):
    """The frames of a dataset, each handed over when it is due; decoded by threads before that.

    A frame is complete when it is due, so decoding that comes late counts as latency.

    Args:
        dataset: the frames.
        rate_hz: frames per second; None keeps the distances of the dataset's time stamps.
        repeat: how many times the recording is played, every second time backward, so that motion has no jump.
        readers: threads that decode.

    Raises:
        ValueError: `rate_hz` or `repeat` is not positive.
    """

    def __init__(
        self, dataset: RgbdDataset, rate_hz: float | None = None, repeat: int = 1, readers: int = READERS
    ) -> None:
        if rate_hz is not None and not 0 < rate_hz < float("inf"):
            raise ValueError(f"ReplaySource: rate_hz must be positive, got {rate_hz}")
        if repeat < 1:
            raise ValueError(f"ReplaySource: repeat must be at least 1, got {repeat}")
        self.name, self.camera, self.dropped = dataset.name, dataset.camera, 0
        self._dataset, self._readers = dataset, readers
        self._order = _there_and_back(len(dataset), repeat)
        poses = dataset.poses()
        self.ground_truth = None if poses is None else poses[self._order]
        self._times = _ascending(dataset.timestamps(), self._order)
        self._due_s = np.arange(len(self._order)) / rate_hz if rate_hz else self._times - self._times[0]
        self._started_s: float | None = None

    def __len__(self) -> int:
        return len(self._order)

    def __getitem__(self, number: int) -> RgbdFrame | None:
        """The frame of a number in the order of playing, decoded; None where it is far too late for that."""
        if self._started_s is not None and time.monotonic() > self._started_s + self._due_s[number] + LATE_S:
            return None
        frame = self._dataset[int(self._order[number])]
        frame.timestamp = float(self._times[number])
        if number and self._order[number] < self._order[number - 1]:
            # On the way back what was taken later comes first.
            frame.offsets = CaptureOffsets(-frame.offsets.depth, -frame.offsets.color)
        return frame

    def frames(self) -> Iterator[LiveFrame | DatasetError | None]:
        with prefetch(self, self._readers, AHEAD) as decoded:
            for number, frame in enumerate(decoded):
                if self._started_s is None:
                    self._started_s = time.monotonic()
                due_s = self._started_s + float(self._due_s[number])
                while (left_s := due_s - time.monotonic()) > 0:
                    time.sleep(min(left_s, _NAP_S))
                    if left_s > _NAP_S:
                        yield None
                if frame is None:
                    self.dropped += 1
                else:
                    yield frame if isinstance(frame, DatasetError) else LiveFrame(frame, due_s)


def _there_and_back(count: int, repeat: int) -> np.ndarray:
    """int64: the frame of each number: all of them, back again without repeating the last, and so on."""
    there = np.arange(count)
    passes = [there if turn % 2 == 0 else there[::-1] for turn in range(repeat)]
    return np.concatenate([one if turn == 0 else one[1:] for turn, one in enumerate(passes)])


def _ascending(timestamps: np.ndarray, order: np.ndarray) -> np.ndarray:
    """float64 [N], s: times of the frames in that order; the way back takes as long as the way there."""
    there, steps = len(timestamps), np.abs(np.diff(timestamps[order]))
    return np.concatenate([timestamps, timestamps[-1] + np.cumsum(steps[there - 1 :])])
