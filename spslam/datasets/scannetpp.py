"""ScanNet++ (Yeshwanth et al. 2023): the iPhone recording of a scene.

As downloaded `iphone/` has `rgb.mkv` (or mp4, 1920x1440), `depth.bin` (256x192, per frame the number of bytes and
16-bit millimeters packed by LZ4, or floats by zlib) and `pose_intrinsic_imu.json`, per frame `timestamp`, `intrinsic`
(3x3, of the video), `pose` and, after alignment to the laser scan, `aligned_pose` (4x4 camera to world, OpenCV axes).
The two are of different worlds: where any frame has `aligned_pose`, those without have no known pose.
The authors' toolkit unpacks `rgb/frame_NNNNNN.jpg` and `depth/frame_NNNNNN.png`, which are read in place of the former.
"""

from __future__ import annotations

import re
import struct
import zlib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from spslam.datasets.base import MAX_FRAMES
from spslam.datasets.files import find_numbered, require_folder
from spslam.datasets.image_files import ColorFiles, DepthFiles, first_depth_size
from spslam.datasets.images import Size, depth_in_meters, first_size
from spslam.datasets.lens import Lens
from spslam.datasets.recording import Calibration, ImageStream, Recording, TimedImages, View
from spslam.datasets.text import camera_from_matrix, checked_poses
from spslam.datasets.video import VideoStream
from spslam.errors import DatasetError, brief
from spslam.reading import open_regular, parse_json, read_text

POSES_FILE, DEPTH_FILE = "pose_intrinsic_imu.json", "depth.bin"
_VIDEO_FILES = ("rgb.mkv", "rgb.mp4")
_DEPTH_SIZE = (256, 192)
_UNITS_PER_METER = 1000.0
_FRAMES_PER_SECOND = 60.0
# The IMU readings of each frame are in there too: 4 kB per frame, and recordings of ten minutes.
_MAX_POSES_BYTES = 1 << 28
_FRAME = re.compile(r"frame_(\d{1,9})")


@dataclass(frozen=True)
class _PackedDepth(ImageStream):
    """The depth images of `depth.bin`; `places` are where each begins, and one more, the end."""

    path: Path
    places: np.ndarray
    seconds: np.ndarray

    def __len__(self) -> int:
        return len(self.places) - 1

    def times(self) -> np.ndarray:
        return self.seconds.copy()

    def describe(self, number: int) -> str:
        return f"{self.path}, frame {number}"

    def read(self, number: int) -> np.ndarray:
        with open_regular(self.path, DatasetError) as file:
            file.seek(int(self.places[number]) + 4)
            content = file.read(int(self.places[number + 1] - self.places[number]) - 4)
        return depth_in_meters(_unpack(content, self.describe(number)), _UNITS_PER_METER)


def open_scannetpp(path: Path, view: View = "depth") -> Recording:
    """Opens the iPhone recording of a scene.

    Args:
        path: the scene, or its folder `iphone`.
        view: see `Recording`.

    Raises:
        DatasetError: a missing file, another layout, or malformed poses.
    """
    folder = path / "iphone" if (require_folder(path) / "iphone").is_dir() else path
    frames = _read_frames(folder / POSES_FILE)
    colors = find_numbered(folder / "rgb", r"frame_(\d+)\.(?:jpg|jpeg|png)")
    color, color_numbers, size = _color_stream(folder, colors)
    depth, depth_numbers, depth_size = _depth_stream(folder)
    numbers = sorted(frames.keys() & color_numbers.keys() & depth_numbers.keys())
    if not numbers:
        raise DatasetError(
            f"{folder}: must contain frames with a pose, a color and a depth image, got {len(frames)} poses, "
            f"{len(color_numbers)} color and {len(depth_numbers)} depth images"
        )
    matrices = np.array([frames[number][0] for number in numbers])
    camera = camera_from_matrix(np.median(matrices, axis=0), *size, str(folder / POSES_FILE))
    seconds = _times(np.array([frames[number][2] for number in numbers]), np.array(numbers))
    pairs = np.array([(color_numbers[number], depth_numbers[number]) for number in numbers], dtype=np.int64)
    return Recording(
        f"scannetpp/{path.name}",
        TimedImages(color, pairs[:, 0], seconds),
        TimedImages(depth, pairs[:, 1], seconds),
        np.repeat(np.arange(len(pairs))[:, None], 2, axis=1),
        Calibration.of_one_view(Lens(camera), depth_size),
        checked_poses(np.array([frames[number][1] for number in numbers]))[0],
        view=view,
    )


def _read_frames(path: Path) -> dict[int, tuple[np.ndarray, np.ndarray, float]]:
    """Intrinsics, pose and time by frame; the pose is NaN where only others are aligned."""
    values = parse_json(read_text(path, _MAX_POSES_BYTES, DatasetError), str(path), DatasetError)
    is_aligned = any(isinstance(entry, dict) and entry.get("aligned_pose") is not None for entry in values.values())
    key = "aligned_pose" if is_aligned else "pose"
    frames = {}
    for name, entry in values.items():
        match = _FRAME.fullmatch(name)
        if match is None or not isinstance(entry, dict):
            raise DatasetError(f"{path}: must have an object per frame (frame_000000), got {brief(name)}")
        source = f"{path}, {name}"
        is_unknown = is_aligned and entry.get(key) is None
        pose = np.full((4, 4), np.nan) if is_unknown else _matrix(entry, key, 4, source)
        time = entry.get("timestamp")
        seconds = float(time) if isinstance(time, (int, float)) else float("nan")
        frames[int(match.group(1))] = _matrix(entry, "intrinsic", 3, source), pose, seconds
    return frames


def _matrix(entry: Mapping[str, Any], key: str, side: int, source: str) -> np.ndarray:
    try:
        return np.array(entry.get(key), dtype=np.float64).reshape(side, side)
    except (TypeError, ValueError):
        raise DatasetError(f"{source}: {key} must be a {side}x{side} matrix, got {brief(entry.get(key))}") from None


def _times(seconds: np.ndarray, numbers: np.ndarray) -> np.ndarray:
    """Those of the file, or of the frames' numbers at 60 Hz where they don't ascend."""
    ascends = np.isfinite(seconds).all() and (np.diff(seconds) > 0).all()
    return seconds if ascends else numbers / _FRAMES_PER_SECOND


def _color_stream(folder: Path, colors: Mapping[int, Path]) -> tuple[ImageStream, dict[int, int], Size]:
    if colors:
        size = first_size(colors.values())
        stream = ColorFiles(list(colors.values()), np.array(list(colors)) / _FRAMES_PER_SECOND, size)
        return stream, {number: row for row, number in enumerate(colors)}, size
    video = next((folder / name for name in _VIDEO_FILES if (folder / name).is_file()), None)
    if video is None:
        raise DatasetError(f"{folder}: must contain {' or '.join(_VIDEO_FILES)}, or rgb/frame_000000.jpg and so on")
    frames = VideoStream(video)
    return frames, {number: number for number in range(len(frames))}, frames.index.size


def _depth_stream(folder: Path) -> tuple[ImageStream, dict[int, int], Size]:
    depths = find_numbered(folder / "depth", r"frame_(\d+)\.png")
    if depths:
        size = first_depth_size(list(depths.values())[:50]) or _DEPTH_SIZE
        times = np.array(list(depths)) / _FRAMES_PER_SECOND
        stream = DepthFiles(list(depths.values()), times, size, _UNITS_PER_METER)
        return stream, {number: row for row, number in enumerate(depths)}, size
    places = _places(folder / DEPTH_FILE)
    count = len(places) - 1
    packed = _PackedDepth(folder / DEPTH_FILE, places, np.arange(count) / _FRAMES_PER_SECOND)
    return packed, {number: number for number in range(count)}, _DEPTH_SIZE


def _places(path: Path) -> np.ndarray:
    """Where the frames begin, and the end: only their lengths are read."""
    places = [0]
    with open_regular(path, DatasetError) as file:
        end = file.seek(0, 2)
        while places[-1] < end and len(places) <= MAX_FRAMES:
            file.seek(places[-1])
            head = file.read(4)
            length = struct.unpack("<I", head)[0] if len(head) == 4 else end
            if places[-1] + 4 + length > end:
                break
            places.append(places[-1] + 4 + length)
    if len(places) < 2:
        raise DatasetError(
            f"{path}: must hold depth images packed one by one; one that is packed as a whole must be unpacked with "
            "the authors' toolkit (python -m iphone.prepare_iphone_data)"
        )
    return np.array(places, dtype=np.int64)


def _unpack(content: bytes, name: str) -> np.ndarray:
    """uint16 [192, 256], mm."""
    width, height = _DEPTH_SIZE
    pixels = width * height
    try:
        import lz4.block
    except ImportError:
        raise DatasetError(f"{name}: depth of ScanNet++ needs lz4: pip install 'spslam[phone]'") from None
    try:
        unpacked = lz4.block.decompress(content, uncompressed_size=2 * pixels)
        if len(unpacked) == 2 * pixels:
            return np.frombuffer(unpacked, "<u2").reshape(height, width)
    except Exception:  # lz4's own error is of a private class: it may be packed by zlib
        pass
    try:
        unpacked = zlib.decompressobj(-zlib.MAX_WBITS).decompress(content, 4 * pixels)
        meters = np.frombuffer(unpacked, "<f4").reshape(height, width)
    except (zlib.error, ValueError) as error:
        raise DatasetError(f"{name}: can't be unpacked: {brief(str(error))}") from None
    return (np.nan_to_num(meters).clip(0, 65) * _UNITS_PER_METER).astype(np.uint16)
