"""Reference poses of image files: from a table, from a file each, or from a trajectory; they never cost an image.

A pose that is damaged, or a file that covers no frame, is said as a doubt: the frames count as without a known pose.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from spslam.datasets.findings import Finding
from spslam.datasets.pairing import interpolate_trajectory, sorted_trajectory
from spslam.datasets.text import read_pose, read_pose_table
from spslam.errors import DatasetError
from spslam.trajectory import Trajectory

_WRITE_NAN = "correct them, or write NaN where a pose is unknown"


@dataclass(frozen=True)
class ReferencePoses:
    """Poses to evaluate against.

    Attributes:
        poses: float64 [F, 4, 4], NaN where unknown; None where the recording has none.
        doubts: what is wrong with them.
    """

    poses: np.ndarray | None = None
    doubts: tuple[Finding, ...] = ()

    @classmethod
    def of(cls, poses: np.ndarray, damaged: Sequence[str], source: str) -> ReferencePoses:
        """Poses of files that are there.

        Args:
            poses: float64 [F, 4, 4], NaN where unknown.
            damaged: what is wrong with each of those that are no rigid motion.
            source: the files.
        """
        if damaged:
            more = f" (and {len(damaged) - 1} more such poses)" if damaged[1:] else ""
            text = f"{damaged[0]}{more}: these frames count as without a known pose"
            return cls(poses, (Finding("damaged poses", text, _WRITE_NAN),))
        if np.isfinite(poses).all(axis=(1, 2)).any():
            return cls(poses)
        text = f"no frame has a known pose: {source} hold no finite one for any"
        return cls(poses, (Finding("reference poses", text, "write the poses, or remove the files"),))


def table_poses(numbers: Sequence[int], path: Path, counts: tuple[int, ...] = ()) -> ReferencePoses:
    """Poses of a table.

    Args:
        numbers: of the frames: row `number` is a frame's pose; those beyond the table have none.
        path: see `spslam.datasets.text.read_pose_table`; may be missing.
        counts: of its rows, the expected one first; any where empty.

    Raises:
        DatasetError: the table can't be read, or has another count of rows.
    """
    if not path.is_file():
        return ReferencePoses()
    table, faults = read_pose_table(path)
    if counts and len(table) not in counts:
        raise DatasetError(
            f"{path}: must have one pose for each of {counts[0]} frames, got {len(table)}; "
            "16 times nan stands for a pose that is unknown"
        )
    rows = np.array(numbers, dtype=np.int64)
    poses = np.full((len(rows), 4, 4), np.nan)
    known = rows < len(table)
    poses[known] = table[rows[known]]
    return ReferencePoses.of(poses, [faults[number] for number in rows.tolist() if number in faults], str(path))


def file_poses(numbers: Sequence[int], files: Mapping[int, Path]) -> ReferencePoses:
    """Poses of a file each; unknown where it is missing, says so or is malformed.

    Args:
        numbers: of the frames.
        files: of poses, by number.
    """
    poses = np.full((len(numbers), 4, 4), np.nan)
    lines, first = [], None
    for row, number in enumerate(numbers):
        path = files.get(number)
        if path is None:
            continue
        first = first or path
        try:
            poses[row] = read_pose(path)
        except DatasetError as error:
            lines.append(str(error))
    if first is None:
        return ReferencePoses()
    return ReferencePoses.of(poses, lines, f"{first} and the other pose files")


def trajectory_poses(path: Path, times: np.ndarray, max_gap_s: float) -> ReferencePoses:
    """Poses of a trajectory in TUM's format at the times of frames.

    Args:
        path: the trajectory; may be missing, unsorted, and have rows that are not finite.
        times: [F], s.
        max_gap_s: between two poses further apart nothing is interpolated.

    Raises:
        DatasetError: as `Trajectory.load_tum`.
    """
    if not path.is_file():
        return ReferencePoses()
    stored = Trajectory.load_tum(path, skip_unknown=True)
    return interpolated_poses(sorted_trajectory(stored.timestamps, stored.poses), times, max_gap_s, str(path))


def interpolated_poses(trajectory: Trajectory, times: np.ndarray, max_gap_s: float, source: str) -> ReferencePoses:
    """Poses of a trajectory at the times of frames.

    Args:
        trajectory: its timestamps must be strictly ascending, its poses finite.
        times: [F], s.
        max_gap_s: between two poses further apart nothing is interpolated.
        source: what the trajectory was read from.
    """
    poses = interpolate_trajectory(trajectory, times, max_gap_s)
    if np.isfinite(poses).any():
        return ReferencePoses(poses)
    return ReferencePoses(None, (_uncovered(source, trajectory.timestamps, times, max_gap_s),))


def _uncovered(source: str, stored: np.ndarray, times: np.ndarray, max_gap_s: float) -> Finding:
    """Why a trajectory has a pose for no frame."""
    if not len(stored):
        return Finding("reference poses", f"{source} holds no pose", "write poses, or remove it")
    if stored[-1] < times.min() or stored[0] > times.max():
        text = (
            f"no frame has a ground-truth pose: {source} covers {stored[0]:.15g} to {stored[-1]:.15g} s, "
            f"the frames {times.min():.15g} to {times.max():.15g} s"
        )
        return Finding("reference poses", text, "bring both to one clock, in seconds")
    apart = float(np.median(np.diff(stored))) if len(stored) > 1 else float("inf")
    text = (
        f"no frame has a ground-truth pose: the poses of {source} are {apart:.3g} s apart, "
        f"and none is interpolated between poses over {max_gap_s:g} s apart"
    )
    return Finding("reference poses", text, f"give poses at least every {max_gap_s:g} s, or at the times of the images")
