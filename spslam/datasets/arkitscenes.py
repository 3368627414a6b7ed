"""ARKitScenes (Baruch et al. 2021): iPads with LiDAR.

A recording has `lowres_wide/ID_TIME.png` (256x192; or `vga_wide/`, `wide/`, larger), `lowres_depth/ID_TIME.png`
(256x192, 16-bit millimeters), `confidence/ID_TIME.png` (0, 1 or 2), per image a file `..._intrinsics/ID_TIME.pincam`
(`width height fx fy cx cy`), and `lowres_wide.traj` (`time`, rotation vector and translation, world to camera, OpenCV
axes, 10 Hz). All images are of one view. Intrinsics change a little with the focus; their medians are used.
"""

from __future__ import annotations

import re
from pathlib import Path

import cv2
import numpy as np

from spslam.datasets.files import require_folder
from spslam.datasets.image_files import ColorFiles, DepthFiles, first_depth_size
from spslam.datasets.images import Size, first_size
from spslam.datasets.lens import Lens
from spslam.datasets.pairing import pair_by_time, sorted_trajectory
from spslam.datasets.recording import Calibration, Recording, View
from spslam.datasets.reference_poses import ReferencePoses, interpolated_poses
from spslam.datasets.text import camera_from_matrix, read_numbers, read_rows
from spslam.errors import DatasetError, brief
from spslam.geometry import inverse, pose_from

COLOR_FOLDERS = ("lowres_wide", "vga_wide", "wide")
DEPTH_FOLDER, CONFIDENCE_FOLDER, TRAJECTORY_FILE = "lowres_depth", "confidence", "lowres_wide.traj"
_UNITS_PER_METER = 1000.0
# The trajectory is at 10 Hz; across a longer gap nothing is made up.
_MAX_GAP_S = 0.35
_INTRINSICS_READ = 50
# Larger numbers of pixels are no camera's, and would overflow where sizes are compared.
_MOST_PX = 1e6
_NAME = re.compile(r"(?:.*_)?(\d+\.\d+)")


def open_arkitscenes(path: Path, min_confidence: int = 0, tolerance_s: float = 0.02, view: View = "depth") -> Recording:
    """Opens a recording.

    Args:
        path: its folder, or the one above of the 3DOD part (that holds `ID_frames`).
        min_confidence: depth of lower confidence (0, 1, 2) comes as 0.
        tolerance_s: images that are less apart are one frame.
        view: see `Recording`.

    Raises:
        DatasetError: a missing folder, no images or intrinsics, or a malformed file.
    """
    folder = _frames_folder(require_folder(path))
    name = next((name for name in COLOR_FOLDERS if (folder / name).is_dir()), None)
    if name is None:
        raise DatasetError(f"{folder}: must contain one of the folders {', '.join(COLOR_FOLDERS)}, got none")
    colors, color_times = _listed(folder / name, ".png")
    depths, depth_times = _listed(folder / DEPTH_FOLDER, ".png")
    size, depth_size = first_size(colors), first_depth_size(depths[:50])
    if depth_size is None:
        raise DatasetError(f"{folder / DEPTH_FOLDER}: must contain depth images that can be read, got none")
    lens = _lens(folder / f"{name}_intrinsics", size)
    pairs = pair_by_time(color_times, depth_times, tolerance_s, str(folder))
    sure = [folder / CONFIDENCE_FOLDER / depth.name for depth in depths]
    stream = DepthFiles(
        depths,
        depth_times,
        depth_size,
        _UNITS_PER_METER,
        confidence=[path if path.is_file() else None for path in sure],
        min_confidence=min_confidence,
    )
    reference = _poses(folder / TRAJECTORY_FILE, depth_times[pairs[:, 1]])
    color = ColorFiles(colors, color_times, size)
    calibration = Calibration.of_one_view(lens, depth_size)
    dataset = Recording(f"arkitscenes/{path.name}", color, stream, pairs, calibration, reference.poses, view=view)
    dataset.doubts = reference.doubts
    return dataset


def _frames_folder(path: Path) -> Path:
    inside = sorted(path.glob("*_frames"))
    return inside[0] if not (path / DEPTH_FOLDER).is_dir() and len(inside) == 1 else path


def _listed(folder: Path, suffix: str) -> tuple[list[Path], np.ndarray]:
    """Files in order of the time in their names, and the times; of files of one time the first."""
    found: dict[float, Path] = {}
    for path in sorted(require_folder(folder).iterdir()):
        match = _NAME.fullmatch(path.stem)
        if path.suffix == suffix and match is not None:
            found.setdefault(float(match.group(1)), path)
    if not found:
        raise DatasetError(f"{folder}: must contain images named ID_TIME{suffix}, got none")
    times = sorted(found)
    return [found[time] for time in times], np.array(times)


def _lens(folder: Path, size: Size) -> Lens:
    files, _ = _listed(folder, ".pincam")
    rows = []
    for path in files[:: max(1, len(files) // _INTRINSICS_READ)]:
        numbers = read_numbers(path)
        # Not the other way round: NaN is neither.
        if numbers.size != 6 or not ((numbers[:2] >= 1).all() and (np.abs(numbers) <= _MOST_PX).all()):
            raise DatasetError(f"{path}: must be `width height fx fy cx cy` in px, got {brief(numbers.tolist())}")
        scale = size[0] / numbers[0], size[1] / numbers[1]
        rows.append(numbers[2:] * (*scale, *scale))
    fx, fy, cx, cy = np.median(rows, axis=0)
    return Lens(camera_from_matrix(np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]]), *size, str(folder)))


def _poses(path: Path, times: np.ndarray) -> ReferencePoses:
    if not path.is_file():
        return ReferencePoses()
    rows = []
    for words in read_rows(path, columns=7):
        try:
            rows.append([float(word) for word in words[:7]])
        except ValueError:
            raise DatasetError(f"{path}: must be `time rx ry rz tx ty tz`, got {brief(' '.join(words))!r}") from None
    table = np.array(rows, dtype=np.float64).reshape(-1, 7)
    table = table[np.isfinite(table).all(axis=1)]
    rotations = np.array([cv2.Rodrigues(row)[0] for row in table[:, 1:4]]).reshape(-1, 3, 3)
    trajectory = sorted_trajectory(table[:, 0], inverse(pose_from(rotations, table[:, 4:])))
    return interpolated_poses(trajectory, times, _MAX_GAP_S, str(path))
