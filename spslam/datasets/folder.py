"""A user's own recording: a folder of color images, a folder of depth images and the intrinsics.

`color/` (or `rgb/`, `images/`) and `depth/`, paired by name (the part before the suffix) or, where the names
differ, by natural order if there are as many of each. Intrinsics in one of `intrinsics.txt`,
`camera-intrinsics.txt` (3x3 or 4x4 matrix, or fx fy cx cy), `intrinsics.json` or `camera.json` (`fx, fy, cx,
cy` and optionally `width, height, depth_scale`). Depth is a 16-bit PNG or TIFF, or floating-point TIFF or npy, with
`depth_scale` units per meter: if nothing says otherwise 1000 for integers and 1 for floating point. Poses aren't
needed; `poses.txt`, with 16 numbers per frame (4x4 camera to world, OpenCV axes), is read if it is there.
"""

from __future__ import annotations

import itertools
import re
from pathlib import Path

import numpy as np

from spslam.camera import Camera
from spslam.datasets.files import FileDataset, FramePaths, attach_pose_table, paired, require_folder
from spslam.datasets.images import DEPTH_SCALE_RULE, Size, first_size, is_depth_scale, read_depth
from spslam.datasets.text import camera_from_matrix, read_intrinsics_matrix, read_json
from spslam.errors import DatasetError, brief

COLOR_FOLDERS = ("color", "rgb", "images")
COLOR_SUFFIXES = (".png", ".jpg", ".jpeg")
DEPTH_SUFFIXES = (".png", ".tif", ".tiff", ".npy")
INTRINSICS_FILES = ("intrinsics.txt", "camera-intrinsics.txt", "intrinsics.json", "camera.json")
FRAMES_PER_SECOND = 30.0
# The median depth of an indoor recording; outside it the scale is wrong, not the room.
PLAUSIBLE_MEDIAN_M = (0.1, 20.0)
# Scales that sensors and datasets use; the one that makes a depth plausible is suggested.
_COMMON_SCALES = (1.0, 1000.0, 5000.0, 6553.5, 10000.0)
_FRAMES_TRIED_FOR_SCALE = 5


def open_folder(folder: Path, depth_scale: float | None = None) -> FileDataset:
    """Opens a recording in the layout above.

    Args:
        folder: the recording.
        depth_scale: depth units per meter; overrides the one in the JSON file.

    Raises:
        DatasetError: a missing folder or intrinsics, intrinsics of another shape or image size, images that can't be
            paired, or a depth scale that puts the median depth outside 0.1 to 20 m.
    """
    colors = _list_images(_color_folder(require_folder(folder)), COLOR_SUFFIXES)
    depths = _list_images(folder / "depth", DEPTH_SUFFIXES)
    frames = _pair(folder, colors, depths)
    width, height = first_size(colors)
    camera, stored_scale = _read_intrinsics(folder, width, height)
    scale = stored_scale if depth_scale is None else depth_scale
    if scale is not None and not is_depth_scale(scale):
        raise DatasetError(f"{folder}: depth_scale must be {DEPTH_SCALE_RULE}, got {scale}")
    _check_scale(frames, scale, (width, height))
    frames, poses = attach_pose_table(dict(enumerate(frames)), folder / "poses.txt")
    return FileDataset(f"folder/{folder.name}", camera, frames, poses, scale)


def _color_folder(folder: Path) -> Path:
    for name in COLOR_FOLDERS:
        if (folder / name).is_dir():
            return folder / name
    raise DatasetError(f"{folder}: must contain a folder color (or rgb, or images) beside depth, got none")


def _list_images(folder: Path, suffixes: tuple[str, ...]) -> list[Path]:
    paths = [
        path for path in require_folder(folder).iterdir() if path.suffix.lower() in suffixes and path.name[0] != "."
    ]
    if not paths:
        raise DatasetError(f"{folder}: must contain images ({', '.join(suffixes)}), got none")
    return sorted(paths, key=lambda path: _natural_order(path.name))


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


def _read_intrinsics(folder: Path, width: int, height: int) -> tuple[Camera, float | None]:
    for name in INTRINSICS_FILES:
        path = folder / name
        if path.is_file():
            if path.suffix == ".json":
                return _read_json_intrinsics(path, width, height)
            return read_intrinsics_matrix(path, width, height), None
    raise DatasetError(f"{folder}: must contain the intrinsics in one of {', '.join(INTRINSICS_FILES)}, got none")


def _read_json_intrinsics(path: Path, width: int, height: int) -> tuple[Camera, float | None]:
    values = read_json(path)
    for name in ("fx", "fy", "cx", "cy"):
        if not _is_number(values.get(name)):
            raise DatasetError(f"{path}: must contain numbers fx, fy, cx, cy, got {name}: {brief(values.get(name))}")
    for name, actual in (("width", width), ("height", height)):
        if name in values and values[name] != actual:
            raise DatasetError(f"{path}: {name} must be the images' {actual}, got {brief(values[name])}")
    scale = values.get("depth_scale")
    if scale is not None and not is_depth_scale(scale):
        raise DatasetError(f"{path}: depth_scale must be {DEPTH_SCALE_RULE}, got {brief(scale)}")
    matrix = np.array([[values["fx"], 0, values["cx"]], [0, values["fy"], values["cy"]], [0, 0, 1]])
    return camera_from_matrix(matrix, width, height, str(path)), scale


def _is_number(value: object) -> bool:
    return isinstance(value, (int, float)) and not isinstance(value, bool)


def _check_scale(frames: list[FramePaths], scale: float | None, size: Size) -> None:
    usable = (frame.depth for frame in frames if frame.fault is None)
    for path in itertools.islice(usable, _FRAMES_TRIED_FOR_SCALE):
        try:
            depth = read_depth(path, scale, size=size)
            stored = read_depth(path, 1.0, size=size)
        except DatasetError:
            continue
        measured = depth[depth > 0]
        if measured.size:
            _check_median(path, float(np.median(measured)), float(np.median(stored[stored > 0])))
            return


def _check_median(path: Path, median: float, stored_median: float) -> None:
    low, high = PLAUSIBLE_MEDIAN_M
    if low <= median <= high:
        return
    fitting = [f"{scale:g}" for scale in _COMMON_SCALES if 0.3 <= stored_median / scale <= 10]
    suggestion = f"; depth_scale {' or '.join(fitting)} would fit" if fitting else ""
    raise DatasetError(
        f"{path}: median depth must be within {low:g} and {high:g} m, "
        f"got {median:.4g} m with depth_scale {stored_median / median:.4g}{suggestion}"
    )
