"""Stray Scanner (iPhone and iPad with LiDAR): a video, depth and confidence images, and ARKit's odometry.

`rgb.mp4` (1920x1440), `depth/NNNNNN.png` (256x192, 16-bit millimeters; `.npy` by early versions),
`confidence/NNNNNN.png` (0, 1 or 2), `camera_matrix.csv` (3x3, of the video) and `odometry.csv` (a header, then
`timestamp, frame, x, y, z, qx, qy, qz, qw`, in newer versions more, some of them empty; camera to world, OpenCV axes).
Depth is registered to the video.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from spslam.datasets.files import find_numbered, require_folder
from spslam.datasets.image_files import DepthFiles, first_depth_size
from spslam.datasets.lens import Lens
from spslam.datasets.recording import Calibration, Recording, TimedImages, View
from spslam.datasets.text import read_intrinsics_matrix, read_table
from spslam.datasets.video import VideoStream
from spslam.errors import DatasetError
from spslam.geometry import pose7_to_matrix

VIDEO_FILE, ODOMETRY_FILE, MATRIX_FILE = "rgb.mp4", "odometry.csv", "camera_matrix.csv"
_POSE = ("qw", "qx", "qy", "qz", "x", "y", "z")
_UNITS_PER_METER = 1000.0


def open_stray_scanner(folder: Path, min_confidence: int = 0, view: View = "depth") -> Recording:
    """Opens a recording of Stray Scanner.

    A frame is one row of the odometry. Its number is that of its depth image and its place in the video.

    Args:
        folder: the recording.
        min_confidence: depth of lower confidence (0, 1, 2) comes as 0.
        view: see `Recording`.

    Raises:
        DatasetError: a missing file, a malformed row, or no depth image that can be read.
    """
    table = read_table(require_folder(folder) / ODOMETRY_FILE)
    path = folder / ODOMETRY_FILE
    for name in _POSE:
        if name not in table:
            raise DatasetError(f"{path}: must have a column {name}, got {', '.join(table)}")
    rows = len(table["x"])
    named = table.get("frame", np.arange(rows))
    depths = find_numbered(folder / "depth", r"(\d+)\.(?:png|npy)")
    size = first_depth_size(list(depths.values())[:50])
    if size is None:
        raise DatasetError(f"{folder / 'depth'}: must contain depth images (000000.png and so on), got none")
    video = VideoStream(folder / VIDEO_FILE)
    lens = Lens(read_intrinsics_matrix(folder / MATRIX_FILE, *video.index.size))
    used = np.flatnonzero((named >= 0) & (named < len(video)))
    if not len(used):
        raise DatasetError(f"{path}: must have frames of {VIDEO_FILE}, which has {len(video)}, got none")
    numbers, first = np.unique(named[used].astype(np.int64), return_index=True)
    used = used[first]
    seconds = table["timestamp"][used] if "timestamp" in table else video.times()[numbers]
    if not np.isfinite(seconds).all() or (np.diff(seconds) <= 0).any():
        raise DatasetError(f"{path}: timestamps must be finite and ascend with the frames")
    confidence = find_numbered(folder / "confidence", r"(\d+)\.png")
    stream = DepthFiles(
        [depths.get(int(number), folder / "depth" / f"{number:06d}.png") for number in numbers],
        seconds,
        size,
        _UNITS_PER_METER,
        confidence=[confidence.get(int(number)) for number in numbers],
        min_confidence=min_confidence,
    )
    poses = known_poses(np.stack([table[name][used] for name in _POSE], axis=1))
    pairs = np.repeat(np.arange(len(used))[:, None], 2, axis=1)
    calibration = Calibration.of_one_view(lens, size)
    # A video has a clock of its own, and its frames were taken with the depth images of their numbers.
    color = TimedImages(video, numbers, seconds)
    return Recording(f"stray_scanner/{folder.name}", color, stream, pairs, calibration, poses, view=view)


def known_poses(rows: np.ndarray) -> np.ndarray:
    """Poses of quaternions and translations.

    Args:
        rows: [F, 7], quaternion (w, x, y, z) and translation.

    Returns:
        float64 [F, 4, 4], NaN where a row is not finite or its quaternion has no length.
    """
    length = np.linalg.norm(rows[:, :4], axis=1)
    known = np.isfinite(rows).all(axis=1) & (length > 1e-6) & (length < 1e6)
    poses = np.full((len(rows), 4, 4), np.nan)
    poses[known] = pose7_to_matrix(rows[known])
    return poses
