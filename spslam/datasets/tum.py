"""TUM RGB-D (Sturm et al. 2012): Kinect and Xtion sequences with motion-capture ground truth.

`rgb.txt` and `depth.txt` list `timestamp file`, `groundtruth.txt` lists `timestamp tx ty tz qx qy qz qw`
(camera to world, OpenCV axes). Depth is 16-bit with 5000 units per meter, registered to the color camera.

Color and depth are taken at different moments, so each color image is paired with the depth image nearest in time. A
frame has the color image's stamp, and the ground truth is interpolated at that time; when the two images were taken is
read from all stamps (`spslam.datasets.clock`), and the tracked pose is that of the depth image. freiburg1's and
freiburg2's color images are distorted, freiburg3's are not; the intrinsics are those the authors calibrated for each.
Both images are undistorted: depth is registered to the color image as it was taken. In freiburg1_rpy's frames 46 to
49, where the camera stands still, edges of undistorted color lie 3 px off those of depth as it is, above in the lower
half and below in the upper one; edges of color as it was taken lie beside those of depth alike in all parts
(docs/experiments/2026-11-color-stamps.md).
"""

from __future__ import annotations

import os
import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from spslam.camera import Camera
from spslam.datasets.base import MAX_FRAMES
from spslam.datasets.clock import capture_offsets, capture_times
from spslam.datasets.files import FileDataset, FramePaths, require_folder
from spslam.datasets.findings import Finding
from spslam.datasets.images import first_size
from spslam.datasets.lens import Lens, Rectification
from spslam.datasets.pairing import associate
from spslam.datasets.reference_poses import trajectory_poses
from spslam.datasets.text import camera_from_matrix, read_numbers, read_rows
from spslam.errors import DatasetError, brief
from spslam.geometry import orthonormalize, pose_from

UNITS_PER_METER = 5000.0
# Further apart, color and depth show different views (the sensor's rate is 30 Hz).
MAX_PAIR_DIFFERENCE_S = 0.02
# Motion capture runs at 100 Hz or more; across a longer gap between two of its poses nothing is made up.
MAX_GROUND_TRUTH_GAP_S = 0.1
CALIBRATION_FILE = "calibration.txt"
_UNKNOWN = "default"
# A stream drops an image now and then; of more, a check of the data says how many.
_USUAL_UNPAIRED = 0.1


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
    # https://www.ipb.uni-bonn.de/data/rgbd-dynamic-dataset
    "bonn": _Calibration(
        (542.822841, 542.57687, 315.59352, 237.756098), (0.039903, -0.099343, -0.00073, -0.000144, 0.0)
    ),
    # What the authors advise where the camera isn't known: ROS's default, no distortion.
    _UNKNOWN: _Calibration((525.0, 525.0, 319.5, 239.5), (0.0, 0.0, 0.0, 0.0, 0.0)),
}


_DEFAULT_CAMERA = Finding(
    "default camera",
    "the camera is not known: neither is there calibration.txt nor has the folder's name freiburg1, 2 or 3 (fr1, ...) "
    "in it, so that of ROS is taken, with a focal length of 525 px at 640x480 and no distortion",
    f"write {CALIBRATION_FILE} with fx fy cx cy (px), and up to five distortion coefficients",
)


# The rotation between Bonn's axes and the camera's, and from the markers on the camera to the camera: T_ros and T_m of
# the authors' script for comparing with their model of the room (https://www.ipb.uni-bonn.de/data/rgbd-dynamic-dataset).
_BONN_AXES = np.array([[-1.0, 0, 0, 0], [0, 0, 1, 0], [0, 1, 0, 0], [0, 0, 0, 1]])
_BONN_MARKERS = np.array(
    [
        [1.0157, 0.1828, -0.2389, 0.0113],
        [0.0009, -0.8431, -0.6413, -0.0098],
        [-0.3009, 0.6147, -0.8085, 0.0111],
        [0, 0, 0, 1],
    ]
)


def open_bonn(folder: Path) -> FileDataset:
    """Opens a sequence of the Bonn RGB-D Dynamic Dataset (Palazzolo et al. 2019), whose layout is TUM's.

    The ground truth is that of markers on the camera in other axes; it is brought to the camera as the authors do.
    Their matrix for that is not quite a rotation, so the nearest rotation is taken.

    Args:
        folder: see `open_tum`.

    Raises:
        DatasetError: see `open_tum`.
    """
    dataset = open_tum(folder, "bonn")
    if dataset.gt_poses is not None:
        markers = pose_from(orthonormalize(_BONN_MARKERS[:3, :3]), _BONN_MARKERS[:3, 3])
        dataset.gt_poses = _BONN_AXES @ dataset.gt_poses @ _BONN_AXES @ markers
    dataset.name = f"bonn/{folder.name}"
    return dataset


def open_tum(folder: Path, calibration: str | None = None) -> FileDataset:
    """Opens a sequence of the TUM RGB-D layout.

    The camera is that of `calibration.txt` in the folder (fx fy cx cy, then up to five distortion coefficients), else
    the one named in the folder's name (`freiburg1` or `fr1`, ...), else ROS's default. Lists may be unsorted; of lines
    with the same timestamp the first counts. Color images without a depth image within 0.02 s are left out. Frames
    outside the time of `groundtruth.txt`, or in a gap of over 0.1 s in it, have no pose; its rows with a number that
    isn't finite are left out, and the file may be missing.

    Args:
        folder: the sequence.
        calibration: whose camera it is if there is no `calibration.txt`; by the folder's name if None.

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
            f"({len(colors)} in rgb.txt, {len(depths)} in depth.txt); time stamps must be in seconds, of one clock"
        )
    taken = (capture_times(_times(stream))[pairs[:, i]] for i, stream in enumerate((colors, depths)))
    offsets = capture_offsets(_times(colors)[pairs[:, 0]], *taken)
    frames = [
        FramePaths(folder / colors[c][1], folder / depths[d][1], colors[c][0], offsets=own)
        for (c, d), own in zip(pairs, offsets, strict=True)
    ]
    size = first_size(frame.color for frame in frames)
    found = _read_calibration(folder / CALIBRATION_FILE, *size)
    name = calibration or _camera_name(folder)
    camera, distortion = found or _known_calibration(name, *size)
    times = np.array([frame.timestamp for frame in frames])
    reference = trajectory_poses(folder / "groundtruth.txt", times, MAX_GROUND_TRUTH_GAP_S)
    is_guessed = found is None and name == _UNKNOWN
    dataset = FileDataset(
        f"tum/{folder.name}",
        camera,
        frames,
        reference.poses,
        UNITS_PER_METER,
        undistortion=Rectification.of(Lens(camera, "brown", distortion)) if any(distortion) else None,
        doubts=(*((_DEFAULT_CAMERA,) if is_guessed else ()), *reference.doubts),
    )
    dataset.remarks, dataset.is_timed = _unpaired(len(colors), len(pairs)), True
    return dataset


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


def names_of(folder: Path) -> tuple[str, ...]:
    """The names that a folder may be known by: its own, and that of a link to it."""
    return folder.resolve().name, Path(os.path.abspath(folder)).name


def _unpaired(colors: int, pairs: int) -> tuple[str, ...]:
    missing = colors - pairs
    if missing <= _USUAL_UNPAIRED * colors:
        return ()
    return (f"depth: {missing} of {colors} color images have no depth image within {MAX_PAIR_DIFFERENCE_S} s",)


def _camera_name(folder: Path) -> str:
    """Whose camera it is by the folder's name."""
    for name in names_of(folder):
        named = re.search(r"(?:freiburg|fr)([123])(?!\d)", name)
        if named:
            return f"freiburg{named.group(1)}"
    return _UNKNOWN


def _known_calibration(name: str, width: int, height: int) -> tuple[Camera, tuple[float, ...]]:
    calibration = _CALIBRATIONS[name]
    return Camera(640, 480, *calibration.intrinsics).resized(width, height), calibration.distortion


def _read_calibration(path: Path, width: int, height: int) -> tuple[Camera, tuple[float, ...]] | None:
    """The camera of a file and its distortion; None where there is no such file."""
    if not path.is_file():
        return None
    numbers = read_numbers(path)
    if not 4 <= numbers.size <= 9:
        raise DatasetError(
            f"{path}: must contain fx fy cx cy and up to five distortion coefficients, got {numbers.size}"
        )
    if not np.isfinite(numbers).all():
        raise DatasetError(f"{path}: must contain finite numbers, got {numbers.tolist()}")
    fx, fy, cx, cy = numbers[:4]
    matrix = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
    distortion = tuple(np.r_[numbers[4:], np.zeros(9 - numbers.size)])
    return camera_from_matrix(matrix, width, height, str(path)), distortion
