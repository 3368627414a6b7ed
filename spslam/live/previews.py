"""Frames of a live run that are kept for the report: the camera will not give them again."""

from __future__ import annotations

from spslam.datasets.base import RgbdFrame


class PreviewStore:
    """Some frames spread evenly over a run whose length is not known beforehand; at most twice as many as asked for.

    Args:
        count: frames wanted.
    """

    def __init__(self, count: int) -> None:
        self._count, self._step = count, 1
        self._kept: list[tuple[int, RgbdFrame]] = []

    def add(self, row: int, frame: RgbdFrame) -> None:
        """Keeps the frame of the next row of the trajectory, or not."""
        if self._count == 0 or row % self._step:
            return
        self._kept.append((row, frame))
        if len(self._kept) > 2 * self._count:
            self._step *= 2
            self._kept = [(row, frame) for row, frame in self._kept if row % self._step == 0]

    def frames(self) -> list[tuple[int, RgbdFrame]]:
        """Rows and frames, ascending, `count` of them if there were as many."""
        if len(self._kept) <= self._count:
            return list(self._kept)
        last = len(self._kept) - 1
        chosen = {round(last * number / max(self._count - 1, 1)) for number in range(self._count)}
        return [self._kept[number] for number in sorted(chosen)]
