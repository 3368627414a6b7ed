"""A camera's path and its file."""

from __future__ import annotations

import os
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from spslam.errors import DatasetError
from spslam.geometry import matrix_to_pose7, pose7_to_matrix
from spslam.io import atomic_write

_HEADER = "# timestamp tx ty tz qx qy qz qw"
_LOST = "# lost frames:"


@dataclass
class Trajectory:
    """Poses in time.

    Attributes
    ----------
    timestamps : float64 [F], seconds.
    poses : float64 [F,4,4], ``T_world_camera``.
    lost : bool [F], frames whose pose is a prediction because tracking failed; all False if not given.
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
        self.lost = np.zeros(count, dtype=bool) if self.lost is None else np.asarray(self.lost, dtype=bool)
        if self.poses.shape != (count, 4, 4):
            raise ValueError(f"Trajectory: poses must have shape {(count, 4, 4)}, got {self.poses.shape}")
        if self.lost.shape != (count,):
            raise ValueError(f"Trajectory: lost must have shape {(count,)}, got {self.lost.shape}")

    def __len__(self) -> int:
        return len(self.timestamps)

    def save_tum(self, path: str | os.PathLike) -> None:
        """Write the TUM format, a line a frame: ``timestamp tx ty tz qx qy qz qw``, camera to world.

        The numbers of lost frames stand in a comment line, which other readers skip. The same trajectory
        gives the same bytes. Poses are kept to a nanometre and 1e-9 in the quaternion. Written at once or not
        at all; raises OutputError.
        """
        lines = [_HEADER]
        if self.lost.any():
            lines.append(" ".join([_LOST, *map(str, np.flatnonzero(self.lost))]))
        for timestamp, row in zip(self.timestamps, matrix_to_pose7(self.poses), strict=True):
            w, x, y, z, *translation = row
            numbers = " ".join(f"{value:.9f}" for value in (*translation, x, y, z, w))
            lines.append(f"{timestamp:.6f} {numbers}")
        atomic_write(path, "\n".join(lines) + "\n")

    @classmethod
    def load_tum(cls, path: str | os.PathLike, skip_unknown: bool = False) -> Trajectory:
        """Read the TUM format; rows stay in the file's order. A file without a pose gives an empty trajectory.

        With ``skip_unknown`` rows with a number that isn't finite are left out; they say that the pose is unknown.
        Raises DatasetError, naming file and line, for a missing file or a line that isn't eight finite numbers
        with a quaternion of a length above 0.
        """
        path = Path(path)
        try:
            lines = path.read_text(encoding="utf-8").splitlines()
        except (OSError, UnicodeDecodeError) as error:
            raise DatasetError(f"{path}: can't be read as a trajectory: {error}") from error
        rows, lost_frames = [], []
        for number, line in enumerate(lines, start=1):
            if line.startswith(_LOST):
                lost_frames = [int(word) for word in line[len(_LOST) :].split() if word.isdigit()]
            elif line.strip() and not line.startswith("#"):
                row = _parse_row(path, number, line, skip_unknown)
                if np.all(np.isfinite(row)):
                    rows.append(row)
        table = np.array(rows, dtype=np.float64).reshape(-1, 8)
        lost = np.zeros(len(table), dtype=bool)
        lost[[frame for frame in lost_frames if frame < len(table)]] = True
        return cls(table[:, 0], pose7_to_matrix(table[:, [7, 4, 5, 6, 1, 2, 3]]), lost)


def _parse_row(path: Path, number: int, line: str, may_be_unknown: bool) -> list[float]:
    try:
        row = [float(word) for word in line.replace(",", " ").split()]
    except ValueError:
        row = []
    if len(row) != 8 or not any(row[4:]) or not (may_be_unknown or np.all(np.isfinite(row))):
        raise DatasetError(
            f"{path}, line {number}: must be `timestamp tx ty tz qx qy qz qw`, got {line.strip()[:80]!r}"
        )
    return row
