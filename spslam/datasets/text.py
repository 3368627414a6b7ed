"""Reading the small text files of datasets: poses, intrinsics, lists; every failure names the file."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from spslam.camera import Camera
from spslam.errors import DatasetError
from spslam.geometry import orthonormalize

# 7-Scenes' rotations are off by up to about 1e-3; a matrix this far from a rotation is no pose at all.
ROTATION_TOLERANCE = 0.1


def read_text(path: Path) -> str:
    """The file's text; raises DatasetError."""
    try:
        return path.read_text(encoding="utf-8")
    except FileNotFoundError:
        raise DatasetError(f"{path}: no such file") from None
    except UnicodeDecodeError:
        raise DatasetError(f"{path}: must be a text file") from None
    except OSError as error:
        raise DatasetError(f"{path}: can't be read: {error.strerror}") from error


def read_numbers(path: Path) -> np.ndarray:
    """All numbers of a file, float64 [N], parted by spaces, commas or line ends; lines with ``#`` are skipped."""
    lines = [line for line in read_text(path).splitlines() if not line.lstrip().startswith("#")]
    words = " ".join(lines).replace(",", " ").split()
    try:
        return np.array(words, dtype=np.float64)
    except ValueError as error:
        raise DatasetError(f"{path}: must hold numbers only: {error}") from error


def read_rows(path: Path, columns: int) -> list[list[str]]:
    """The words of each line that isn't a comment; raises DatasetError for a line of fewer than ``columns``."""
    rows = []
    for number, line in enumerate(read_text(path).splitlines(), start=1):
        words = line.replace(",", " ").split()
        if not words or words[0].startswith("#"):
            continue
        if len(words) < columns:
            raise DatasetError(f"{path}, line {number}: must have {columns} columns, got {line.strip()[:80]!r}")
        rows.append(words)
    return rows


def read_pose(path: Path) -> np.ndarray:
    """One pose [4,4] from 16 (or 12) numbers, row by row; all NaN where the file says that it is unknown."""
    numbers = read_numbers(path)
    if numbers.size not in (12, 16):
        raise DatasetError(f"{path}: a pose must have 16 numbers, got {numbers.size}")
    return checked_pose(numbers, str(path))


def read_pose_table(path: Path) -> tuple[np.ndarray, dict[int, str]]:
    """Poses [F,4,4] of a file with 16 numbers each, row by row, and what is wrong with those that are no rigid motion.

    NaN where the file has a non-finite number, and where the pose is wrong. Raises DatasetError for a file that isn't
    made of sixteens of numbers.
    """
    numbers = read_numbers(path)
    if numbers.size % 16:
        raise DatasetError(f"{path}: must have 16 numbers a pose, got {numbers.size} numbers")
    poses, faults = np.full((numbers.size // 16, 4, 4), np.nan), {}
    for i, row in enumerate(numbers.reshape(-1, 16)):
        try:
            poses[i] = checked_pose(row, f"{path}, pose {i}")
        except DatasetError as error:
            faults[i] = str(error)
    return poses, faults


def checked_pose(numbers: np.ndarray, name: str) -> np.ndarray:
    """The pose [4,4] of 12 or 16 numbers with its rotation projected to SO(3), or all NaN if one isn't finite.

    Raises DatasetError for a matrix that is no rigid motion.
    """
    pose = np.eye(4)
    pose.reshape(-1)[: numbers.size] = numbers
    if not np.all(np.isfinite(pose)):
        return np.full((4, 4), np.nan)
    rotation = pose[:3, :3]
    error = np.abs(rotation.T @ rotation - np.eye(3)).max()
    if error > ROTATION_TOLERANCE or np.linalg.det(rotation) < 0 or np.abs(pose[3] - [0, 0, 0, 1]).max() > 1e-6:
        raise DatasetError(f"{name}: must be a rotation and a translation, got {numbers.tolist()}")
    pose[:3, :3] = orthonormalize(rotation)
    return pose


def read_json(path: Path) -> dict[str, Any]:
    """The object in a JSON file; raises DatasetError."""
    try:
        content = json.loads(read_text(path))
    except json.JSONDecodeError as error:
        raise DatasetError(f"{path}: isn't valid JSON: {error}") from error
    if not isinstance(content, dict):
        raise DatasetError(f"{path}: must hold an object with named values, got {type(content).__name__}")
    return content


def read_intrinsics_matrix(path: Path, width: int, height: int) -> Camera:
    """The camera of a text file with a 3x3 or 4x4 matrix, or with the four numbers fx fy cx cy."""
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
    """A camera whose principal point lies in the image; raises DatasetError that begins with ``name``."""
    try:
        camera = Camera.from_matrix(matrix, width, height)
    except ValueError as error:
        raise DatasetError(f"{name}: {error}") from error
    if not (0 < camera.cx < width and 0 < camera.cy < height):
        raise DatasetError(
            f"{name}: principal point must lie in the image of {width}x{height}, got ({camera.cx:g}, {camera.cy:g})"
        )
    return camera
