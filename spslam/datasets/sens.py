"""ScanNet's ``.sens``: a whole recording in one file (version 4 of its format, little-endian).

The head: version (u32), length (u64) and bytes of the sensor's name, four 4x4 float32 matrices row by row (color's
intrinsics and extrinsics, then depth's), the compressions of color and of depth (i32), width and height of color and
of depth (u32), ``depth_shift`` (f32: depth units a meter) and the number of frames (u64).
Each frame: ``camera_to_world`` (4x4 float32), the times of color and depth in microseconds (u64), the bytes that
either takes (u64), and these. IMU readings follow; they aren't read.
"""

from __future__ import annotations

import os
import struct
import zlib
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import numpy as np

from spslam.datasets.images import decode_color
from spslam.errors import DatasetError

VERSION = 4
_COLOR_SUFFIXES = {1: ".png", 2: ".jpg"}
_RAW, _ZLIB = 0, 1
_LONGEST_NAME = 4096
_LARGEST_SIDE_PX = 1 << 15
_FRAME_HEAD = struct.Struct("<64sQQQQ")


@dataclass(frozen=True)
class SensHeader:
    """What a file says of all its frames.

    Attributes
    ----------
    sensor : its name.
    color_intrinsics, depth_intrinsics : float32 [4,4], pixels.
    color_compression : 0 raw, 1 PNG, 2 JPEG.
    depth_compression : 0 raw, 1 zlib.
    color_size, depth_size : (width, height).
    units_per_meter : stored depth of one meter.
    frames : how many the file should have.
    """

    sensor: str
    color_intrinsics: np.ndarray
    depth_intrinsics: np.ndarray
    color_compression: int
    depth_compression: int
    color_size: tuple[int, int]
    depth_size: tuple[int, int]
    units_per_meter: float
    frames: int


@dataclass(frozen=True)
class SensIndex:
    """Where the frames are and what stands beside them; F whole frames, fewer than announced if the file is cut.

    Attributes
    ----------
    poses : float32 [F,16], ``camera_to_world`` as stored; minus infinity where unknown.
    times_us : uint64 [F], of the color images.
    offsets : int64 [F], where the color image begins in the file; depth follows it.
    color_bytes, depth_bytes : int64 [F].
    """

    poses: np.ndarray
    times_us: np.ndarray
    offsets: np.ndarray
    color_bytes: np.ndarray
    depth_bytes: np.ndarray

    def __len__(self) -> int:
        return len(self.offsets)


class SensFile:
    """A ``.sens`` file: header and index are read on opening, an image when it is asked for, from any thread.

    Raises
    ------
    DatasetError
        For a file that is missing, empty, of another version, compressed otherwise than above, or cut in its head.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        try:
            with path.open("rb") as file:
                self.header = _read_header(file, path)
                self.index = _read_index(file, self.header.frames)
        except FileNotFoundError:
            raise DatasetError(f"{path}: no such file") from None
        except OSError as error:
            raise DatasetError(f"{path}: can't be read: {error.strerror}") from error

    def describe(self, frame: int) -> str:
        """What an error about a frame should name."""
        return f"{self.path}, frame {frame}"

    def color(self, frame: int) -> np.ndarray:
        """Color image of a frame, uint8 [H,W,3], RGB. Raises DatasetError."""
        content = self._bytes(self.index.offsets[frame], self.index.color_bytes[frame])
        name, (width, height) = f"{self.describe(frame)}, color", self.header.color_size
        if self.header.color_compression != _RAW:
            return decode_color(content, _COLOR_SUFFIXES[self.header.color_compression], name)
        if len(content) != 3 * width * height:
            raise DatasetError(f"{name}: must be {3 * width * height} bytes, got {len(content)}")
        return np.frombuffer(content, dtype=np.uint8).reshape(height, width, 3).copy()

    def depth(self, frame: int) -> np.ndarray:
        """Depth image of a frame as stored, uint16 [H,W]. Raises DatasetError."""
        content = self._bytes(self.index.offsets[frame] + self.index.color_bytes[frame], self.index.depth_bytes[frame])
        name, (width, height) = f"{self.describe(frame)}, depth", self.header.depth_size
        if self.header.depth_compression == _ZLIB:
            try:
                content = zlib.decompress(content)
            except zlib.error as error:
                raise DatasetError(f"{name}: can't be decompressed: {error}") from error
        if len(content) != 2 * width * height:
            raise DatasetError(f"{name}: must be {2 * width * height} bytes, got {len(content)}")
        return np.frombuffer(content, dtype="<u2").reshape(height, width)

    def _bytes(self, offset: int, count: int) -> bytes:
        try:
            with self.path.open("rb") as file:
                file.seek(offset)
                return file.read(count)
        except OSError as error:
            raise DatasetError(f"{self.path}: can't be read: {error.strerror}") from error


def _read_header(file: BinaryIO, path: Path) -> SensHeader:
    if not os.fstat(file.fileno()).st_size:
        raise DatasetError(f"{path}: the file is empty")
    try:
        (version,) = _unpack(file, "<I")
        if version != VERSION:
            raise DatasetError(f"{path}: must be a .sens file of version {VERSION}, got {version}")
        (length,) = _unpack(file, "<Q")
        if length > _LONGEST_NAME:
            raise DatasetError(f"{path}: must be a .sens file, but its sensor's name would be {length} bytes long")
        sensor = file.read(length).decode("utf-8", errors="replace")
        matrices = np.array(_unpack(file, "<64f"), dtype=np.float32).reshape(4, 4, 4)
        color_compression, depth_compression = _unpack(file, "<2i")
        color_width, color_height, depth_width, depth_height = _unpack(file, "<4I")
        units_per_meter, frames = _unpack(file, "<fQ")
    except struct.error:
        raise DatasetError(f"{path}: the file is truncated in its head") from None
    if color_compression not in (_RAW, *_COLOR_SUFFIXES) or depth_compression not in (_RAW, _ZLIB):
        raise DatasetError(
            f"{path}: must hold color as raw, PNG or JPEG (0, 1, 2) and depth as raw or zlib (0, 1), "
            f"got {color_compression} and {depth_compression}"
        )
    sizes = (color_width, color_height), (depth_width, depth_height)
    if not all(0 < side <= _LARGEST_SIDE_PX for size in sizes for side in size):
        raise DatasetError(
            f"{path}: image sizes must be within 1 and {_LARGEST_SIDE_PX} px, got {sizes[0]}, {sizes[1]}"
        )
    if not 0 < units_per_meter < float("inf"):
        raise DatasetError(f"{path}: depth_shift must be positive, got {units_per_meter}")
    return SensHeader(
        sensor, matrices[0], matrices[2], color_compression, depth_compression, *sizes, units_per_meter, frames
    )


def _read_index(file: BinaryIO, frames: int) -> SensIndex:
    """Hops from frame to frame; ends with the last one that is whole."""
    end = os.fstat(file.fileno()).st_size
    offset = file.tell()
    rows: list[tuple[int, int, int, int]] = []
    poses: list[bytes] = []
    while len(rows) < frames and offset + _FRAME_HEAD.size <= end:
        file.seek(offset)
        pose, color_time, _, color_bytes, depth_bytes = _FRAME_HEAD.unpack(file.read(_FRAME_HEAD.size))
        begin = offset + _FRAME_HEAD.size
        offset = begin + color_bytes + depth_bytes
        if offset > end:
            break
        rows.append((color_time, begin, color_bytes, depth_bytes))
        poses.append(pose)
    # One column at a time: the times may fill all 64 bits.
    times, begins, color_sizes, depth_sizes = zip(*rows, strict=True) if rows else ((), (), (), ())
    return SensIndex(
        np.frombuffer(b"".join(poses), dtype="<f4").reshape(-1, 16),
        np.array(times, dtype=np.uint64),
        np.array(begins, dtype=np.int64),
        np.array(color_sizes, dtype=np.int64),
        np.array(depth_sizes, dtype=np.int64),
    )


def _unpack(file: BinaryIO, form: str) -> tuple:
    return struct.unpack(form, file.read(struct.calcsize(form)))
