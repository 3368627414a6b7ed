"""Reading the small text files of datasets: poses, intrinsics, lists; every failure names the file."""

from __future__ import annotations

from array import array
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from spslam.camera import Camera
from spslam.errors import DatasetError, brief
from spslam.geometry import orthonormalize
from spslam.reading import MAX_JSON_BYTES, parse_json, read_lines, read_text

# 7-Scenes' rotations are off by up to about 1e-3; a matrix this far from a rotation is no pose at all.
ROTATION_TOLERANCE = 0.1
_LAST_ROW_TOLERANCE = 1e-6
# Of a table of poses: lines of 4 come in fours.
_POSE_COLUMNS = (4, 12, 16)
# No camera's focal length lies outside; with any, ratios of two cameras would overflow.
_FOCAL_RANGE_PX = (0.1, 1e6)


def read_numbers(path: Path) -> np.ndarray:
    """All numbers of a file, float64 [N].

    Args:
        path: numbers separated by spaces, commas or line ends; lines that begin with `#` are skipped.

    Raises:
        DatasetError: no such file, not a text file, or something else than numbers in it.
    """
    numbers = array("d")
    for line in read_lines(path, DatasetError):
        numbers.extend(_parsed(line, path))
    return np.array(numbers, dtype=np.float64)


def _parsed(line: str, path: Path) -> list[float]:
    """The numbers of a line, none of a comment."""
    if line.lstrip().startswith("#"):
        return []
    try:
        return [float(word) for word in line.replace(",", " ").split()]
    except ValueError as error:
        raise DatasetError(f"{path}: must contain numbers only: {brief(str(error))}") from None


def read_rows(path: Path, columns: int) -> Iterator[list[str]]:
    """The words of each line that isn't a comment.

    Args:
        path: words separated by spaces or commas.
        columns: fewest words of a line.

    Raises:
        DatasetError: no such file, not a text file, or a line of fewer words.
    """
    for number, line in enumerate(read_lines(path, DatasetError), start=1):
        words = line.replace(",", " ").split()
        if not words or words[0].startswith("#"):
            continue
        if len(words) < columns:
            raise DatasetError(f"{path}, line {number}: must have {columns} columns, got {brief(line)!r}")
        yield words


def read_table(path: Path) -> dict[str, np.ndarray]:
    """The columns of a file whose first line names them.

    Args:
        path: lines of words separated by commas or, where a line has none, by spaces; the names in any case.

    Returns:
        float64 [N] per name, NaN where nothing stands between two commas.

    Raises:
        DatasetError: no such file, no row, a row of another length, or something else than numbers in it.
    """
    names: list[str] = []
    numbers = array("d")
    for line in read_lines(path, DatasetError):
        words = _fields(line)
        if not any(words) or words[0].startswith("#"):
            continue
        if not names:
            names = [word.lower() for word in words]
            continue
        try:
            values = [float(word) if word else float("nan") for word in words]
        except ValueError as error:
            raise DatasetError(f"{path}: must contain numbers below its first line: {brief(str(error))}") from None
        if len(values) != len(names):
            raise DatasetError(f"{path}: rows must have {len(names)} columns as the first, got {brief(line)!r}")
        numbers.extend(values)
    if not names or not numbers:
        raise DatasetError(f"{path}: must have a line of names and rows of numbers, got none")
    table = np.array(numbers, dtype=np.float64).reshape(-1, len(names))
    return {name: table[:, column] for column, name in enumerate(names)}


def _fields(line: str) -> list[str]:
    """The words of a table's line, empty ones among them: Stray Scanner leaves columns without a value empty."""
    return [word.strip() for word in line.split(",")] if "," in line else line.split()


def read_pose(path: Path) -> np.ndarray:
    """One pose [4, 4] from 16 (or 12) numbers, row by row; all NaN where the file says that it is unknown.

    Raises:
        DatasetError: another count of numbers, or no rigid motion.
    """
    numbers = read_numbers(path)
    if numbers.size not in (12, 16):
        raise DatasetError(f"{path}: a pose must have 16 numbers, got {numbers.size}")
    return checked_pose(numbers, str(path))


def read_pose_table(path: Path) -> tuple[np.ndarray, dict[int, str]]:
    """Poses of a file: a row of 16 numbers each (4x4, row by row), or of 12 (3x4), or four lines of 4.

    Returns:
        float64 [F, 4, 4], NaN where the file has a non-finite number or no rigid motion; and what is wrong with the
        latter, by number.

    Raises:
        DatasetError: no such file, not a text file, something else than numbers in it, or rows of another length.
    """
    numbers, columns, lines = array("d"), 0, 0
    for number, line in enumerate(read_lines(path, DatasetError), start=1):
        row = _parsed(line, path)
        if not row:
            continue
        columns, lines = columns or len(row), lines + 1
        # Rows of other files, such as TUM's trajectories of 8 numbers, would make up matrices where they are joined.
        if len(row) not in _POSE_COLUMNS or len(row) != columns:
            raise DatasetError(f"{path}: {_pose_rule(len(row))}, got {len(row)} numbers in line {number}")
        numbers.extend(row)
    if columns == 4 and lines % 4:
        raise DatasetError(f"{path}: {_pose_rule(4)}, got {lines} lines of 4 numbers")
    size = 12 if columns == 12 else 16
    stored = np.tile(np.eye(4), (len(numbers) // size, 1, 1))
    rows = stored.reshape(len(stored), 16)
    rows[:, :size] = np.array(numbers, dtype=np.float64).reshape(-1, size)
    poses, is_motion = checked_poses(stored)
    faults = {int(i): motion_fault(f"{path}, pose {i}", rows[i]) for i in np.flatnonzero(~is_motion)}
    return poses, faults


def _pose_rule(columns: int) -> str:
    """What a table of poses must hold; names the format that a row of another length looks like."""
    rule = "must have 16 numbers per pose (4x4, row by row, as one row or four lines; or 12, without the last row)"
    return rule + (", not a time, a position and a quaternion" if columns == 8 else "")


def checked_pose(numbers: np.ndarray, name: str) -> np.ndarray:
    """One pose, as `checked_poses` does it.

    Args:
        numbers: 12 or 16 of them, row by row.
        name: what the error begins with.

    Returns:
        float64 [4, 4].

    Raises:
        DatasetError: no rigid motion.
    """
    pose = np.eye(4)
    pose.reshape(-1)[: numbers.size] = numbers
    poses, is_motion = checked_poses(pose[None])
    if not is_motion[0]:
        raise DatasetError(motion_fault(name, numbers))
    return poses[0]


def checked_poses(stored: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Poses with their rotations projected to SO(3).

    Args:
        stored: [F, 4, 4].

    Returns:
        float64 [F, 4, 4], all NaN where a number isn't finite or the matrix is no rigid motion; and bool [F], False for
        the latter.
    """
    stored = stored.astype(np.float64)
    known = np.isfinite(stored).all(axis=(1, 2))
    rotation, last_row = stored[:, :3, :3], stored[:, 3]
    with np.errstate(over="ignore", invalid="ignore"):
        error = np.abs(rotation.transpose(0, 2, 1) @ rotation - np.eye(3)).max(axis=(1, 2))
        determinant = np.linalg.det(rotation)
        is_motion = (error <= ROTATION_TOLERANCE) & (determinant >= 0)
        is_motion &= np.abs(last_row - [0, 0, 0, 1]).max(axis=1) <= _LAST_ROW_TOLERANCE
    poses = np.full_like(stored, np.nan)
    poses[is_motion] = stored[is_motion]
    poses[is_motion, :3, :3] = orthonormalize(rotation[is_motion])
    return poses, is_motion | ~known


def motion_fault(name: str, numbers: np.ndarray) -> str:
    """What is wrong with a pose of these numbers that is no rigid motion; `name` is what the line begins with."""
    return f"{name}: must be a rotation and a translation, got {numbers.tolist()}"


def read_json(path: Path) -> dict[str, Any]:
    """The object in a JSON file; raises DatasetError."""
    return parse_json(read_text(path, MAX_JSON_BYTES, DatasetError), str(path), DatasetError)


def read_intrinsics_matrix(path: Path, width: int, height: int) -> Camera:
    """The camera of a text file.

    Args:
        path: a 3x3 or 4x4 matrix, or the four numbers fx fy cx cy.
        width: of the images, px.
        height: of the images, px.

    Raises:
        DatasetError: another count of numbers, or as `camera_from_matrix`.
    """
    numbers = read_numbers(path)
    if numbers.size == 4:
        fx, fy, cx, cy = numbers
        matrix = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
    elif numbers.size in (9, 16):
        side = 3 if numbers.size == 9 else 4
        matrix = numbers.reshape(side, side)[:3, :3]
    else:
        raise DatasetError(f"{path}: intrinsics must be a 3x3 or 4x4 matrix or fx fy cx cy, got {numbers.size} numbers")
    return camera_from_matrix(matrix, width, height, str(path))


def camera_from_matrix(matrix: np.ndarray, width: int, height: int, name: str) -> Camera:
    """A camera that images may be of: its focal lengths are plausible, and its principal point lies in the image.

    Args:
        matrix: intrinsics [3, 3] or [4, 4].
        width: of the images, px.
        height: of the images, px.
        name: what the error begins with.

    Raises:
        DatasetError: no intrinsics of a pinhole camera, a focal length outside 0.1 to 1,000,000 px, or a principal
            point outside the image.
    """
    try:
        camera = Camera.from_matrix(matrix, width, height)
    except ValueError as error:
        raise DatasetError(f"{name}: {error}") from error
    least, most = _FOCAL_RANGE_PX
    if not (least <= camera.fx <= most and least <= camera.fy <= most):
        raise DatasetError(
            f"{name}: focal lengths must be from {least:g} to {most:g} px, got {camera.fx:g} and {camera.fy:g}"
        )
    if not (0 < camera.cx < width and 0 < camera.cy < height):
        raise DatasetError(
            f"{name}: principal point must lie in the image of {width}x{height}, got ({camera.cx:g}, {camera.cy:g})"
        )
    return camera
