"""TUM RGB-D (Sturm et al. 2012): Kinect and Xtion sequences with motion-capture ground truth.

`rgb.txt` and `depth.txt` list `timestamp file`, `groundtruth.txt` lists `timestamp tx ty tz qx qy qz qw`
(camera to world, OpenCV axes). Depth is 16-bit with 5000 units per meter, registered to the color camera.

Color and depth are taken at different moments, so each color image is paired with the depth image nearest in time,
and the ground truth is interpolated at the color image's time. freiburg1's and freiburg2's color images are distorted,
freiburg3's are not; the intrinsics are those the authors calibrated for each. Color is undistorted; depth is left as
it is, because it comes from another lens: carried from view to view with the ground-truth poses, the depth images of
freiburg1_rpy agree better as they are (median 2.8, 4.9, 5.1 cm over 5, 10, 15 frames) than undistorted with the color
camera's coefficients (3.0, 5.3, 5.3 cm).
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from spslam.camera import Camera
from spslam.datasets.base import MAX_FRAMES
from spslam.datasets.files import FileDataset, FramePaths, Undistortion, require_folder
from spslam.datasets.images import first_size
from spslam.datasets.text import camera_from_matrix, read_numbers, read_rows
from spslam.errors import DatasetError, brief
from spslam.geometry import interpolate_pose
from spslam.trajectory import Trajectory

UNITS_PER_METER = 5000.0
# Further apart, color and depth show different views (the sensor's rate is 30 Hz).
MAX_PAIR_DIFFERENCE_S = 0.02
# Motion capture runs at 100 Hz or more; across a longer gap between two of its poses nothing is made up.
MAX_GROUND_TRUTH_GAP_S = 0.1
# A depth camera at 200 Hz has 8 images within that time.
_MAX_CANDIDATES = 16
CALIBRATION_FILE = "calibration.txt"


@dataclass(frozen=True)
class _Calibration:
    """fx fy cx cy for 640x480 and OpenCV's distortion k1 k2 p1 p2 k3."""

    intrinsics: tuple[float, float, float, float]
    distortion: tuple[float, float, float, float, float]


# https://cvg.cit.tum.de/data/datasets/rgbd-dataset/file_formats, table "Intrinsic camera calibration", color cameras.
_CALIBRATIONS = {
    "freiburg1": _Calibration((517.3, 516.5, 318.6, 255.3), (0.2624, -0.9531, -0.0054, 0.0026, 1.1633)),
    "freiburg2": _Calibration((520.9, 521.0, 325.1, 249.7), (0.2312, -0.7849, -0.0033, -0.0001, 0.9172)),
    "freiburg3": _Calibration((535.4, 539.2, 320.1, 247.6), (0.0, 0.0, 0.0, 0.0, 0.0)),
    # What the authors advise where the camera isn't known: ROS's default, no distortion.
    "default": _Calibration((525.0, 525.0, 319.5, 239.5), (0.0, 0.0, 0.0, 0.0, 0.0)),
}


def open_tum(folder: Path) -> FileDataset:
    """Opens a sequence of the TUM RGB-D layout.

    The camera is that of `calibration.txt` in the folder (fx fy cx cy, then up to five distortion coefficients), else
    the one named in the folder's name (`freiburg1` or `fr1`, ...), else ROS's default. Lists may be unsorted; of lines
    with the same timestamp the first counts. Color images without a depth image within 0.02 s are left out. Frames
    outside the time of `groundtruth.txt`, or in a gap of over 0.1 s in it, have no pose; its rows with a number that
    isn't finite are left out, and the file may be missing.

    Args:
        folder: the sequence.

    Raises:
        DatasetError: a missing folder or list, a malformed line, no pair at all, unreadable calibration.
    """
    colors = _read_list(require_folder(folder) / "rgb.txt")
    depths = _read_list(folder / "depth.txt")
    try:
        pairs = associate(_times(colors), _times(depths), MAX_PAIR_DIFFERENCE_S)
    except ValueError as error:
        raise DatasetError(f"{folder / 'rgb.txt'}: {error}") from None
    if not len(pairs):
        raise DatasetError(
            f"{folder}: must have color and depth images within {MAX_PAIR_DIFFERENCE_S} s of each other, got none "
            f"({len(colors)} in rgb.txt, {len(depths)} in depth.txt)"
        )
    frames = [FramePaths(folder / colors[c][1], folder / depths[d][1], colors[c][0]) for c, d in pairs]
    camera, distortion = _find_calibration(folder, *first_size(frame.color for frame in frames))
    return FileDataset(
        f"tum/{folder.name}",
        camera,
        frames,
        _interpolated_ground_truth(folder / "groundtruth.txt", np.array([frame.timestamp for frame in frames])),
        UNITS_PER_METER,
        undistortion=Undistortion.of(camera, distortion) if any(distortion) else None,
    )


def associate(times_a: np.ndarray, times_b: np.ndarray, max_difference: float) -> np.ndarray:
    """Pairs the nearest times of two lists; each time is in one pair at most.

    The closest pairs are taken first, as by the dataset's `associate.py`.

    Args:
        times_a: [A], ascending.
        times_b: [B], ascending.
        max_difference: pairs are less than this apart.

    Returns:
        Pairs (i, j), int64 [P, 2], ascending.

    Raises:
        ValueError: times are so close to each other that there are over 16 candidates for a pair on average.
    """
    first = np.searchsorted(times_b, times_a - max_difference)
    last = np.searchsorted(times_b, times_a + max_difference)
    count = int((last - first).sum())
    if count > _MAX_CANDIDATES * len(times_a):
        raise ValueError(f"must have at most {_MAX_CANDIDATES} images within {max_difference} s of each, got {count}")
    i = np.repeat(np.arange(len(times_a)), last - first)
    j = np.arange(count) - np.repeat(np.cumsum(last - first) - last, last - first)
    difference = np.abs(times_a[i] - times_b[j])
    near = np.lexsort((j, i, difference))
    near = near[difference[near] < max_difference]
    used_a: set[int] = set()
    used_b: set[int] = set()
    pairs = []
    for pair in zip(i[near].tolist(), j[near].tolist(), strict=True):
        if pair[0] not in used_a and pair[1] not in used_b:
            used_a.add(pair[0])
            used_b.add(pair[1])
            pairs.append(pair)
    return np.array(sorted(pairs), dtype=np.int64).reshape(-1, 2)


def interpolate_trajectory(trajectory: Trajectory, times: np.ndarray, max_gap: float) -> np.ndarray:
    """Interpolates a trajectory.

    Args:
        trajectory: its timestamps must be strictly ascending.
        times: [F], s.
        max_gap: between two poses further apart than this (s) nothing is interpolated.

    Returns:
        float64 [F, 4, 4], NaN outside the trajectory and in its gaps.
    """
    poses = np.full((len(times), 4, 4), np.nan)
    if len(trajectory) == 0:
        return poses
    after = np.clip(np.searchsorted(trajectory.timestamps, times), 1, max(len(trajectory) - 1, 1))
    after = np.minimum(after, len(trajectory) - 1)
    before = np.maximum(after - 1, 0)
    start, end = trajectory.timestamps[before], trajectory.timestamps[after]
    fraction = np.where(end > start, (times - start) / np.where(end > start, end - start, 1), 0)
    exact = (times == start) | (times == end)
    known = (times >= start) & (times <= end) & ((end - start <= max_gap) | exact)
    poses[known] = interpolate_pose(trajectory.poses[before[known]], trajectory.poses[after[known]], fraction[known])
    return poses


def _read_list(path: Path) -> list[tuple[float, str]]:
    entries: dict[float, str] = {}
    for words in read_rows(path, columns=2):
        try:
            timestamp = float(words[0])
        except ValueError:
            raise DatasetError(f"{path}: must list `timestamp file`, got {brief(' '.join(words))!r}") from None
        if not np.isfinite(timestamp):
            raise DatasetError(f"{path}: timestamps must be finite, got {brief(words[0])}")
        entries.setdefault(timestamp, words[1])
        if len(entries) > MAX_FRAMES:
            raise DatasetError(f"{path}: must list at most {MAX_FRAMES} images")
    if not entries:
        raise DatasetError(f"{path}: must list at least one image, got none")
    return sorted(entries.items())


def _times(entries: list[tuple[float, str]]) -> np.ndarray:
    return np.array([timestamp for timestamp, _ in entries])


def _find_calibration(folder: Path, width: int, height: int) -> tuple[Camera, tuple[float, ...]]:
    path = folder / CALIBRATION_FILE
    if path.is_file():
        numbers = read_numbers(path)
        if not 4 <= numbers.size <= 9:
            raise DatasetError(
                f"{path}: must contain fx fy cx cy and up to five distortion coefficients, got {numbers.size}"
            )
        if not np.isfinite(numbers).all():
            raise DatasetError(f"{path}: must contain finite numbers, got {numbers.tolist()}")
        fx, fy, cx, cy = numbers[:4]
        matrix = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
        return camera_from_matrix(matrix, width, height, str(path)), tuple(
            np.r_[numbers[4:], np.zeros(9 - numbers.size)]
        )
    named = re.search(r"(?:freiburg|fr)([123])(?!\d)", folder.resolve().name)
    calibration = _CALIBRATIONS[f"freiburg{named.group(1)}" if named else "default"]
    return Camera(640, 480, *calibration.intrinsics).resized(width, height), calibration.distortion


def _interpolated_ground_truth(path: Path, times: np.ndarray) -> np.ndarray | None:
    if not path.is_file():
        return None
    ground_truth = Trajectory.load_tum(path, skip_unknown=True)
    timestamps, first = np.unique(ground_truth.timestamps, return_index=True)
    return interpolate_trajectory(Trajectory(timestamps, ground_truth.poses[first]), times, MAX_GROUND_TRUTH_GAP_S)
