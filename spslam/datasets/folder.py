"""A user's own recording: a folder of color images, a folder of depth images and the intrinsics.

`color/` (or `rgb/`, `image/`, `images/`) and `depth/`, paired by name (the part before the suffix) or, where the names
differ, by natural order if there are as many of each. Cameras are read from the files of
`spslam.datasets.calibration_files`: their distortion is undone, and color and depth of two cameras are registered.
Depth is a 16-bit PNG or TIFF, or floating-point TIFF or npy, with `depth_scale` units per meter: if nothing says
otherwise 1000 for integers and 1 for floating point. `confidence/`, 8-bit images of the names of the depth images, is
heeded if it is there. Poses aren't needed; `poses.txt`, with 16 numbers per frame (4x4 color camera to world, OpenCV
axes; NaN where unknown), is read if it is there, and so is `times.txt`, one time (s) per frame.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from spslam.datasets.base import RgbdDataset
from spslam.datasets.calibration_files import read_calibration
from spslam.datasets.files import FileDataset, FramePaths, paired, require_folder
from spslam.datasets.image_files import ColorFiles, DepthFiles, usual_depth_size
from spslam.datasets.images import DEPTH_SCALE_RULE, is_depth_scale, read_depth, usual_size
from spslam.datasets.recording import Calibration, Recording, View
from spslam.datasets.reference_poses import table_poses
from spslam.datasets.text import read_numbers
from spslam.errors import DatasetError

COLOR_FOLDERS = ("color", "rgb", "image", "images")
COLOR_SUFFIXES = (".png", ".jpg", ".jpeg")
DEPTH_SUFFIXES = (".png", ".tif", ".tiff", ".npy")
CONFIDENCE_FOLDER, TIMES_FILE, POSES_FILE = "confidence", "times.txt", "poses.txt"
FRAMES_PER_SECOND = 30.0
# The median depth of an indoor recording; outside it the scale is wrong, not the room.
PLAUSIBLE_MEDIAN_M = (0.1, 20.0)
# Scales that sensors and datasets use; the one that makes a depth plausible is suggested.
_COMMON_SCALES = (1.0, 1000.0, 5000.0, 6553.5, 10000.0)
_FRAMES_TRIED_FOR_SCALE = 5
# Beyond what 16 bits hold, or not measured: no surface, but near in units of 0.1 mm.
SATURATED = (65535,)


def open_folder(
    folder: Path, depth_scale: float | None = None, min_confidence: int = 0, view: View = "depth"
) -> RgbdDataset:
    """Opens a recording in the layout above.

    Args:
        folder: the recording.
        depth_scale: depth units per meter; overrides the one in the JSON file.
        min_confidence: depth of lower confidence comes as 0.
        view: see `Recording`; has no effect on images of one camera and one size.

    Raises:
        DatasetError: a missing folder or intrinsics, intrinsics of another shape or image size, a camera that is not
            fully described, images that can't be paired, times that don't ascend, another count of times or poses than
            of frames, or a depth scale that puts the median depth outside 0.1 to 20 m.
    """
    colors = list_images(_color_folder(require_folder(folder)), COLOR_SUFFIXES)
    depths = list_images(folder / "depth", DEPTH_SUFFIXES)
    found = _pair(folder, colors, depths)
    frames = with_times(found, folder / TIMES_FILE)
    (size, odd_colors), (depth_size, odd_depths) = usual_size(colors), usual_depth_size(depths)
    frames = _with_faults(frames, odd_colors | odd_depths)
    calibration, stored_scale = read_calibration(folder, size, depth_size)
    scale = stored_scale if depth_scale is None else depth_scale
    if scale is not None and not is_depth_scale(scale):
        raise DatasetError(f"{folder}: depth_scale must be {DEPTH_SCALE_RULE}, got {scale}")
    check_scale([frame.depth for frame in frames if frame.fault is None], scale)
    # A recording that was killed may have the pose of a last frame whose time it has not.
    reference = table_poses(range(len(frames)), folder / POSES_FILE, (len(frames), len(found)))
    confidence = _confidence_files(folder / CONFIDENCE_FOLDER, frames) if min_confidence > 0 else None
    name = f"folder/{folder.name}"
    if confidence is None and _is_one_camera(calibration):
        camera, poses = calibration.color.camera, reference.poses
        return FileDataset(name, camera, frames, poses, scale, invalid_depth=SATURATED, doubts=reference.doubts)
    dataset = file_recording(name, frames, calibration, reference.poses, scale, confidence, min_confidence, view)
    dataset.doubts = reference.doubts
    return dataset


def file_recording(
    name: str,
    frames: Sequence[FramePaths],
    calibration: Calibration,
    poses: np.ndarray | None,
    units_per_meter: float | None,
    confidence: Sequence[Path | None] | None,
    min_confidence: int,
    view: View,
) -> Recording:
    """A recording whose images are files, paired already; see `Recording` and `DepthFiles`.

    Frames have their depth images' time stamps; `FramePaths.offsets` say how much later the color images' are.
    """
    seconds = np.array([frame.timestamp for frame in frames])
    color_seconds = seconds + np.array([frame.offsets.color for frame in frames])
    color, depth = calibration.color.camera, calibration.depth.camera
    pairs = np.repeat(np.arange(len(frames))[:, None], 2, axis=1)
    return Recording(
        name,
        ColorFiles([frame.color for frame in frames], color_seconds, (color.width, color.height)),
        DepthFiles(
            [frame.depth for frame in frames],
            seconds,
            (depth.width, depth.height),
            units_per_meter,
            SATURATED,
            confidence=confidence,
            min_confidence=min_confidence,
        ),
        pairs,
        calibration,
        poses,
        view=view,
        faults={number: frame.fault for number, frame in enumerate(frames) if frame.fault is not None},
    )


def with_times(frames: list[FramePaths], path: Path) -> list[FramePaths]:
    """Frames with the times of a file, one per frame, s; as they are where there is no such file.

    A last frame without a time is left out where frames are numbered as `spslam.live.FolderRecorder` does it: it was
    being written when the recording was killed.

    Raises:
        DatasetError: another count of times than of frames, or times that don't ascend.
    """
    if not path.is_file():
        return frames
    times = read_numbers(path)
    if len(times) == len(frames) - 1 > 0 and _counts_from_zero(frames):
        frames = frames[:-1]
    if len(times) != len(frames):
        raise DatasetError(f"{path}: must have one time (s) for each of {len(frames)} frames, got {len(times)}")
    ascends = np.isfinite(times) & np.r_[True, np.diff(times) > 0]
    if not ascends.all():
        first = int(np.flatnonzero(~ascends)[0])
        raise DatasetError(
            f"{path}: times must be finite and ascend, but number {first + 1}, {times[first]:.6f}, does not"
        )
    return [replace(frame, timestamp=float(time)) for frame, time in zip(frames, times, strict=True)]


def _with_faults(frames: list[FramePaths], faults: Mapping[Path, str]) -> list[FramePaths]:
    """Frames with what is wrong with their images; those that have a fault keep it."""
    if not faults:
        return frames
    return [replace(frame, fault=frame.fault or faults.get(frame.color) or faults.get(frame.depth)) for frame in frames]


def _counts_from_zero(frames: Sequence[FramePaths]) -> bool:
    """Whether frames are named 000000, 000001, ..., so that a name tells its row in a file of all frames."""
    return all(frame.depth.stem == f"{number:06d}" for number, frame in enumerate(frames))


def _is_one_camera(calibration: Calibration) -> bool:
    """Whether there is nothing to put right."""
    color, depth = calibration.color, calibration.depth
    return color == depth and not color.is_distorted and np.array_equal(calibration.color_from_depth, np.eye(4))


def _confidence_files(folder: Path, frames: Sequence[FramePaths]) -> list[Path | None] | None:
    """The confidence map of each frame's depth image; None where the recording has none."""
    if not folder.is_dir():
        return None
    found = {path.stem: path for path in list_images(folder, (".png",))}
    maps = [found.get(frame.depth.stem) for frame in frames]
    if not any(maps):
        raise DatasetError(
            f"{folder}: maps must have the names of the depth images, got {next(iter(found.values())).name} beside "
            f"{frames[0].depth.name}; rename them, or set dataset.min_confidence=0 to do without"
        )
    return maps


def _color_folder(folder: Path) -> Path:
    present = [name for name in COLOR_FOLDERS if (folder / name).is_dir()]
    if not present:
        raise DatasetError(f"{folder}: must contain a folder color (or rgb, image, images) beside depth, got none")
    filled = [name for name in present if _images(folder / name, COLOR_SUFFIXES)]
    if len(filled) > 1:
        raise DatasetError(
            f"{folder}: must contain one folder of color images, got {' and '.join(filled)}; rename or move the other"
        )
    return folder / (filled or present)[0]


def list_images(folder: Path, suffixes: tuple[str, ...]) -> list[Path]:
    """The images of a folder in natural order; raises DatasetError where there are none, or two of one name."""
    paths = _images(require_folder(folder), suffixes)
    if not paths:
        raise DatasetError(f"{folder}: must contain images ({', '.join(suffixes)}), got none")
    ordered = sorted(paths, key=lambda path: _natural_order(path.name))
    found: dict[str, Path] = {}
    for path in ordered:
        other = found.setdefault(path.stem, path)
        if other is not path:
            raise DatasetError(f"{path}: must be the only image of its name, got {other.name} as well; remove one")
    return ordered


def _images(folder: Path, suffixes: tuple[str, ...]) -> list[Path]:
    return [path for path in folder.iterdir() if path.suffix.lower() in suffixes and path.name[0] != "."]


def _natural_order(name: str) -> list[tuple[int, str]]:
    parts = re.split(r"(\d+)", name)
    return [(int(part), "") if part.isdecimal() else (-1, part) for part in parts]


def _pair(folder: Path, colors: list[Path], depths: list[Path]) -> list[FramePaths]:
    color_of, depth_of = ({path.stem: path for path in paths} for paths in (colors, depths))
    if color_of.keys() & depth_of.keys():
        stems = sorted(color_of.keys() | depth_of.keys(), key=_natural_order)
        return [paired(color_of.get(stem), depth_of.get(stem), i / FRAMES_PER_SECOND) for i, stem in enumerate(stems)]
    if len(colors) == len(depths):
        return [paired(*pair, i / FRAMES_PER_SECOND) for i, pair in enumerate(zip(colors, depths, strict=True))]
    raise DatasetError(
        f"{folder}: color and depth images must have the same names or be as many, got {len(colors)} and {len(depths)}"
    )


def check_scale(paths: Sequence[Path], scale: float | None) -> None:
    """Raises DatasetError where a depth scale puts the median depth of images out of all bounds.

    A few are looked at, spread over the recording, until one is plausible: a hand before the lens is near, too.
    """
    first_fault = None
    for path in paths[:: -(-len(paths) // _FRAMES_TRIED_FOR_SCALE) or 1]:
        try:
            depth = read_depth(path, scale, SATURATED)
            stored = read_depth(path, 1.0, SATURATED)
        except DatasetError:
            continue
        measured = depth[depth > 0]
        if measured.size:
            fault = _median_fault(path, float(np.median(measured)), float(np.median(stored[stored > 0])))
            if fault is None:
                return
            first_fault = first_fault or fault
    if first_fault is not None:
        raise DatasetError(first_fault)


def _median_fault(path: Path, median: float, stored_median: float) -> str | None:
    low, high = PLAUSIBLE_MEDIAN_M
    if low <= median <= high:
        return None
    fitting = [f"{scale:g}" for scale in _COMMON_SCALES if 0.3 <= stored_median / scale <= 10]
    suggestion = f"; depth_scale {' or '.join(fitting)} would fit" if fitting else ""
    return (
        f"{path}: median depth must be within {low:g} and {high:g} m, "
        f"got {median:.4g} m with depth_scale {stored_median / median:.4g}{suggestion}"
    )
