"""Open3D's and Redwood's recordings (Choi, Zhou, Koltun 2015): images by number, and a trajectory with a matrix each.

`color/` (or `rgb/`, `image/`, or `NAME-color/`) and `depth/` (or `NAME-depth-clean/` and its like) with `000000.jpg` or
Redwood's `0000001-000000033369.jpg` (number and microseconds); depth of 16 bits. The camera is in
`camera_intrinsic.json` or `intrinsic.json` (with `depth_scale` where Open3D's recorder wrote it), else PrimeSense's
(525, 525, 319.5, 239.5 at 640x480), with millimeters, which is a doubt where names are not Redwood's. Poses are those
of a `.log` file (three whole numbers, the first the frame's, then a 4x4 camera to world) named `trajectory.log`,
`NAME_trajectory.log` or `NAME-traj.txt`.
"""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np

from spslam.camera import Camera
from spslam.datasets.calibration_files import INTRINSICS_FILES, read_calibration
from spslam.datasets.clock import AT_ONCE, CaptureOffsets
from spslam.datasets.files import FramePaths, paired, require_folder
from spslam.datasets.findings import Finding
from spslam.datasets.folder import check_scale, file_recording
from spslam.datasets.image_files import first_depth_size
from spslam.datasets.images import first_size
from spslam.datasets.lens import Lens
from spslam.datasets.recording import Calibration, Recording, View
from spslam.datasets.reference_poses import ReferencePoses
from spslam.datasets.text import checked_poses, motion_fault, read_numbers
from spslam.errors import DatasetError

_REDWOOD_COLOR = "*-color"
_COLOR_FOLDERS, _DEPTH_FOLDERS = ("color", "rgb", "image", _REDWOOD_COLOR), ("depth", "*-depth*")
_IMAGE = re.compile(r"(\d{1,12})(?:-(\d{1,15}))?\.(png|jpg|jpeg)")
_PRIMESENSE = Camera(640, 480, 525.0, 525.0, 319.5, 239.5)
_UNITS_PER_METER = 1000.0
_FRAMES_PER_SECOND = 30.0
_NUMBERS_PER_POSE = 19
_DEFAULT_CAMERA = Finding(
    "default camera",
    "the camera is not known: there are no intrinsics, so that PrimeSense's is taken, with a focal length of 525 px at "
    "640x480",
    "write intrinsics.txt with fx fy cx cy (px) of the color images",
)


def open_open3d(folder: Path, depth_scale: float | None = None, view: View = "depth") -> Recording:
    """Opens a recording.

    Args:
        folder: that holds the folders of images.
        depth_scale: depth units per meter; overrides the one in the JSON file.
        view: see `Recording`.

    Raises:
        DatasetError: missing folders, images without numbers, or a malformed camera or trajectory.
    """
    frames = _frames(require_folder(folder))
    paths = list(frames.values())
    size = first_size(frame.color for frame in paths)
    depth_size = first_depth_size([frame.depth for frame in paths][:50])
    scale: float | None = _UNITS_PER_METER
    doubts: tuple[Finding, ...] = ()
    if any((folder / name).is_file() for name in INTRINSICS_FILES):
        calibration, stored = read_calibration(folder, size, depth_size)
        scale = stored or scale
    else:
        calibration = Calibration.of_one_view(Lens(_PRIMESENSE.resized(*size)), depth_size or size)
        is_redwood = find_folder(folder, (_REDWOOD_COLOR,)) is not None or _has_redwood_names(paths)
        doubts = () if is_redwood else (_DEFAULT_CAMERA,)
    scale = depth_scale or scale
    check_scale([frame.depth for frame in paths if frame.fault is None], scale)
    reference = _reference_poses(folder, len(frames))
    dataset = file_recording(f"open3d/{folder.name}", paths, calibration, reference.poses, scale, None, 0, view)
    dataset.doubts = (*doubts, *reference.doubts)
    return dataset


def find_folder(folder: Path, patterns: tuple[str, ...]) -> Path | None:
    """The first folder in another one whose name matches one of some patterns."""
    for pattern in patterns:
        found = sorted(path for path in folder.glob(pattern) if path.is_dir())
        if found:
            return found[0]
    return None


def _frames(folder: Path) -> dict[int, FramePaths]:
    """Frames by number, ascending."""
    colors, depths = find_folder(folder, _COLOR_FOLDERS), find_folder(folder, _DEPTH_FOLDERS)
    if colors is None or depths is None:
        kind = "color" if colors is None else "depth"
        raise DatasetError(f"{folder}: must contain a folder of {kind} images, got none")
    color_files, depth_files = _numbered(colors), _numbered(depths)
    if not color_files or not depth_files:
        raise DatasetError(f"{colors if not color_files else depths}: must contain numbered images, got none")
    frames = {}
    for number in sorted(color_files.keys() | depth_files.keys()):
        color, depth = color_files.get(number), depth_files.get(number)
        path, microseconds = depth or color or (folder, None)
        seconds = number / _FRAMES_PER_SECOND if microseconds is None else microseconds * 1e-6
        frames[number] = paired(color and color[0], depth and depth[0], seconds)
        stamps = [image[1] for image in (color, depth) if image is not None and image[1] is not None]
        if len(stamps) == 2:
            frames[number] = replace(frames[number], offsets=CaptureOffsets(color=(stamps[0] - stamps[1]) * 1e-6))
    times = np.array([frame.timestamp for frame in frames.values()])
    if (np.diff(times) <= 0).any():  # Redwood's clock starts anew in some recordings
        return {
            number: replace(frame, timestamp=number / _FRAMES_PER_SECOND, offsets=AT_ONCE)
            for number, frame in frames.items()
        }
    return frames


def _has_redwood_names(frames: list[FramePaths]) -> bool:
    """Whether an image has a time in its name, as PrimeSense's have that Redwood's recorder wrote."""
    match = _IMAGE.fullmatch(frames[0].color.name)
    return match is not None and match[2] is not None


def _numbered(folder: Path) -> dict[int, tuple[Path, int | None]]:
    found: dict[int, tuple[Path, int | None]] = {}
    for path in sorted(folder.iterdir()):
        match = _IMAGE.fullmatch(path.name)
        if match is None:
            continue
        other, _ = found.setdefault(int(match[1]), (path, None if match[2] is None else int(match[2])))
        if other is not path:
            raise DatasetError(f"{path}: must be the only image of its number, got {other.name} as well; remove one")
    return found


def _reference_poses(folder: Path, frames: int) -> ReferencePoses:
    path = trajectory_file(folder)
    if path is None:
        return ReferencePoses()
    values = read_numbers(path)
    if not values.size or values.size % _NUMBERS_PER_POSE:
        raise DatasetError(
            f"{path}: must have three whole numbers and a 4x4 matrix per pose, got {values.size} numbers"
        )
    rows = values.reshape(-1, _NUMBERS_PER_POSE)
    stored, is_motion = checked_poses(rows[:, 3:].reshape(-1, 4, 4))
    poses = np.full((frames, 4, 4), np.nan)
    # The first number counts the frames from 0, whatever the first image is called.
    places = rows[:, 0]
    known = np.isfinite(places) & (places >= 0) & (places < frames)
    poses[places[known].astype(np.int64)] = stored[known]
    damaged = [motion_fault(f"{path}, pose {row}", rows[row, 3:]) for row in np.flatnonzero(~is_motion)]
    return ReferencePoses.of(poses, damaged, str(path))


def trajectory_file(folder: Path) -> Path | None:
    """The file of a recording's poses; None where there is none."""
    patterns = ("trajectory.log", "*_trajectory.log", "*-traj.txt", "scene/trajectory.log")
    for place, names in ((folder, patterns), (folder.parent, (f"{folder.name}_trajectory.log",))):
        for name in names:
            found = sorted(place.glob(name))
            if found:
                return found[0]
    return None
