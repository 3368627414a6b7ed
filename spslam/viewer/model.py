"""What a viewer knows of a run: one row per frame, in arrays that grow."""

from __future__ import annotations

import threading
from dataclasses import dataclass

import numpy as np

from spslam.camera import Camera
from spslam.geometry import inverse, pose7_to_matrix
from spslam.viewer.protocol import Loop, Row, Update

_FIRST_CAPACITY = 256


@dataclass(frozen=True)
class RunInfo:
    """What does not change.

    Attributes:
        name: of the sequence.
        camera: intrinsics.
        total: number of frames; None where it is not known.
        depth_range_m: of usable depth, m.
        can_pause: whether the run waits where it is asked to, or frames can be moved through.
    """

    name: str
    camera: Camera
    total: int | None
    depth_range_m: tuple[float, float]
    can_pause: bool = True


class RunModel:
    """The frames of a run so far, F of them.

    Attributes:
        info: what does not change.
        ground_truth: float64 [N, 4, 4] by source index, NaN where unknown, moved so that it begins where the estimated
            path does; or None.
        loops: numbers of the frames of loops that were closed.
        lock: to be held where several of the arrays are read that belong together.
    """

    def __init__(self, info: RunInfo, ground_truth: np.ndarray | None = None):
        self.info = info
        self.ground_truth = ground_truth
        self.lock = threading.RLock()
        self.loops: list[Loop] = []
        self._is_aligned = False
        self._count = 0
        self._poses = np.zeros((_FIRST_CAPACITY, 4, 4))
        self._columns = {name: np.zeros(_FIRST_CAPACITY) for name in Row._fields}

    def __len__(self) -> int:
        return self._count

    @property
    def poses(self) -> np.ndarray:
        """float64 [F, 4, 4] T_world_camera; those of lost frames are guesses."""
        return self._poses[: self._count]

    @property
    def lost(self) -> np.ndarray:
        """bool [F]."""
        return self.column("lost") > 0

    def column(self, name: str) -> np.ndarray:
        """float64 [F]: a field of `Row` for all frames."""
        return self._columns[name][: self._count]

    def tracked_poses(self, count: int) -> np.ndarray:
        """float64 [n, 4, 4], a copy: poses of the first `count` frames, as far as they have come and are not lost."""
        with self.lock:
            return self.poses[:count][~self.lost[:count]]

    def update(self, update: Update) -> None:
        """Adds frames. Those that were never sent repeat the last pose."""
        with self.lock:
            self._update(update)

    def set_poses(self, poses: np.ndarray) -> None:
        """Takes refined poses, float32 [n, 7], of the first n frames."""
        with self.lock:
            count = min(len(poses), self._count)
            self._poses[:count] = pose7_to_matrix(np.asarray(poses[:count], np.float64))

    def _update(self, update: Update) -> None:
        end = update.first + len(update.rows)
        self._reserve(end)
        if update.first > self._count:
            missing = slice(self._count, update.first)
            self._poses[missing] = self._poses[self._count - 1] if self._count else np.eye(4)
            for name, column in self._columns.items():
                column[missing] = np.nan if name not in ("lost", "mapped", "relocalized") else 0
        new = slice(update.first, end)
        self._poses[new] = pose7_to_matrix(np.asarray(update.poses, np.float64))
        table = np.array(update.rows, np.float64).reshape(-1, len(Row._fields))
        for name, values in zip(Row._fields, table.T, strict=True):
            self._columns[name][new] = values
        self._count = max(end, self._count)
        self.loops += update.loops
        self._align()

    def _reserve(self, count: int) -> None:
        capacity = len(self._poses)
        if count <= capacity:
            return
        more = max(2 * capacity, count) - capacity
        self._poses = np.concatenate([self._poses, np.zeros((more, 4, 4))])
        self._columns = {name: np.concatenate([column, np.zeros(more)]) for name, column in self._columns.items()}

    def _align(self) -> None:
        """Moves the ground truth so that the first frame that it knows has its estimated pose."""
        if self._is_aligned or self.ground_truth is None:
            return
        rows = self.column("source_index").astype(int)
        for row, index in enumerate(rows):
            known = 0 <= index < len(self.ground_truth) and bool(np.isfinite(self.ground_truth[index]).all())
            if known and not self.lost[row]:
                move = self._poses[row] @ inverse(self.ground_truth[index])
                self.ground_truth = move @ self.ground_truth
                self._is_aligned = True
                return
