"""A camera trajectory and its file."""

from __future__ import annotations

import math
import os
from array import array
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from spslam.errors import DatasetError, brief
from spslam.geometry import matrix_to_pose7, pose7_to_matrix
from spslam.io import atomic_write
from spslam.notebook import trajectory_html
from spslam.reading import read_lines

MAX_POSES = 1 << 20  # of a file: an hour of motion capture at 300 Hz
_HEADER = "# timestamp tx ty tz qx qy qz qw"
_LOST = "# lost"
_SHORTEST, _LONGEST = 1e-100, 1e100  # of a quaternion
_NO_POSE = " 0 0 0 0 0 0 1"


@dataclass(repr=False)
class Trajectory:
    """Camera poses over time.

    Attributes:
        timestamps: float64 [F], seconds.
        poses: float64 [F, 4, 4], `T_world_camera`.
        lost: bool [F], frames without a known pose; all False if not given. Their rows of `poses` are finite
            placeholders: the last known pose before them, or the first known pose where there is none before.

    Raises:
        ValueError: arrays of other or different shapes.
    """

    timestamps: np.ndarray
    poses: np.ndarray
    lost: np.ndarray = field(default=None)  # type: ignore[arg-type, assignment]

    def __post_init__(self) -> None:
        self.timestamps = np.asarray(self.timestamps, dtype=np.float64)
        self.poses = np.asarray(self.poses, dtype=np.float64)
        if self.timestamps.ndim != 1:
            raise ValueError(f"Trajectory: timestamps must have shape (F,), got {self.timestamps.shape}")
        count = len(self.timestamps)
        if count == 0:
            self.poses = self.poses.reshape(0, 4, 4)
        self.lost = np.zeros(count, dtype=bool) if self.lost is None else np.array(self.lost, dtype=bool)
        if self.poses.shape != (count, 4, 4):
            raise ValueError(f"Trajectory: poses must have shape {(count, 4, 4)}, got {self.poses.shape}")
        if self.lost.shape != (count,):
            raise ValueError(f"Trajectory: lost must have shape {(count,)}, got {self.lost.shape}")
        self.poses = _hold_known(self.poses, self.lost)

    def __len__(self) -> int:
        return len(self.timestamps)

    def __repr__(self) -> str:
        seconds = float(self.timestamps[-1] - self.timestamps[0]) if len(self) else 0.0
        return f"Trajectory({len(self)} poses, {int(self.lost.sum())} lost, {seconds:.1f} s)"

    def _repr_html_(self) -> str:
        """What a notebook shows: the path from where it is widest, and its figures."""
        return trajectory_html(self.timestamps, self.poses, self.lost)

    def mask_lost(self, ground_truth: np.ndarray) -> np.ndarray:
        """Ground-truth poses, float64 [F, 4, 4], set to NaN for the lost frames, to measure errors against."""
        return np.where(self.lost[:, None, None], np.nan, ground_truth)

    def save_tum(self, path: str | os.PathLike) -> None:
        """Writes the TUM format, one line per frame: `timestamp tx ty tz qx qy qz qw`, camera to world.

        A lost frame is written as a comment, `# lost timestamp`, which other readers skip. Values are rounded to 1e-9
        (meters, and quaternion components). The same trajectory gives the same bytes. The file is written atomically.

        Raises:
            OutputError: the file cannot be written.
        """
        lines = [_HEADER]
        for timestamp, row, lost in zip(self.timestamps, matrix_to_pose7(self.poses), self.lost, strict=True):
            w, x, y, z, *translation = row
            numbers = " ".join(f"{value:.9f}" for value in (*translation, x, y, z, w))
            lines.append(f"{_LOST} {timestamp:.6f}" if lost else f"{timestamp:.6f} {numbers}")
        atomic_write(path, "\n".join(lines) + "\n")

    @classmethod
    def load_tum(cls, path: str | os.PathLike, skip_unknown: bool = False) -> Trajectory:
        """Reads the TUM format; rows stay in the file's order. A file without a frame gives an empty trajectory.

        Args:
            path: the file.
            skip_unknown: leave out rows with a number that is not finite, by which some datasets mark an unknown pose.

        Raises:
            DatasetError: a missing file, or a line that is not eight finite numbers with a quaternion of a length
                above 0, or more than `MAX_POSES` poses. Names file and line.
        """
        path = Path(path)
        rows, lost = array("d"), bytearray()
        for number, line in enumerate(read_lines(path, DatasetError), start=1):
            is_lost = line.startswith(f"{_LOST} ")
            if is_lost:
                line = line.removeprefix(_LOST) + _NO_POSE
            if line.strip() and not line.startswith("#"):
                row = _parse_row(path, number, line, skip_unknown)
                if all(map(math.isfinite, row)):
                    rows.extend(row)
                    lost.append(is_lost)
            if len(lost) > MAX_POSES:
                raise DatasetError(f"{path}: must have at most {MAX_POSES} poses")
        table = np.array(rows, dtype=np.float64).reshape(-1, 8)
        return cls(table[:, 0], pose7_to_matrix(table[:, [7, 4, 5, 6, 1, 2, 3]]), np.array(lost, dtype=bool))


def _hold_known(poses: np.ndarray, lost: np.ndarray) -> np.ndarray:
    """Poses with each lost row replaced by the last known row, or by the first known row where none is before."""
    known = np.flatnonzero(~lost)
    if not lost.any() or not len(known):
        return poses
    before = np.searchsorted(known, np.arange(len(poses)), side="right") - 1
    return poses[known[before.clip(min=0)]]


def _parse_row(path: Path, number: int, line: str, may_be_unknown: bool) -> list[float]:
    try:
        row = [float(word) for word in line.replace(",", " ").split()]
    except ValueError:
        row = []
    is_finite = all(map(math.isfinite, row))
    # Lengths whose square is 0 or infinite in floating point can't be divided by.
    is_turn = len(row) == 8 and (not is_finite or _SHORTEST < math.hypot(*row[4:]) < _LONGEST)
    if not is_turn or not (may_be_unknown or is_finite):
        raise DatasetError(f"{path}, line {number}: must be `timestamp tx ty tz qx qy qz qw`, got {brief(line)!r}")
    return row
