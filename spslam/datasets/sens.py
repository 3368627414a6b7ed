"""ScanNet's `.sens`: a whole recording in one file (version 4 of its format, little-endian).

The head: version (u32), length (u64) and bytes of the sensor's name, four 4x4 float32 matrices row by row (color's
intrinsics and extrinsics, then depth's), the compressions of color and of depth (i32), width and height of color and
of depth (u32), `depth_shift` (f32: depth units per meter) and the number of frames (u64).
Each frame: `camera_to_world` (4x4 float32), the times of color and depth in microseconds (u64), the bytes that
either takes (u64), and these. IMU readings follow; they aren't read.
"""

from __future__ import annotations

import math
import os
import struct
import zlib
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import numpy as np

from spslam.datasets.base import MAX_FRAMES
from spslam.datasets.images import DEPTH_SCALE_RULE, Size, check_image_size, decode_color, is_depth_scale
from spslam.errors import DatasetError
from spslam.reading import open_regular

VERSION = 4
_RAW, _PNG, _JPEG = 0, 1, 2
_ZLIB = 1
_LONGEST_NAME = 4096
# A compressed image may be larger than the pixels it holds, but not much; PNG and JPEG may carry notes.
_MOST_COMPRESSED_SHARE, _MOST_NOTES_BYTES = 2, 1 << 16
_COLOR_BYTES, _DEPTH_BYTES = 3, 2
_FRAME_SIZES = struct.Struct("<QQ")  # bytes of color and of depth, the last of a frame's head
_FRAME_HEAD = np.dtype(
    [
        ("pose", "<f4", 16),
        ("color_time_us", "<u8"),
        ("depth_time_us", "<u8"),
        ("color_bytes", "<u8"),
        ("depth_bytes", "<u8"),
    ]
)


@dataclass(frozen=True)
class SensHeader:
    """What a file says of all its frames.

    Attributes:
        sensor: its name.
        color_intrinsics: float32 [4, 4], px.
        depth_intrinsics: float32 [4, 4], px.
        color_compression: 0 raw, 1 PNG, 2 JPEG.
        depth_compression: 0 raw, 1 zlib.
        color_size: (width, height).
        depth_size: (width, height).
        units_per_meter: stored depth of one meter.
        frames: how many the file should have.
    """

    sensor: str
    color_intrinsics: np.ndarray
    depth_intrinsics: np.ndarray
    color_compression: int
    depth_compression: int
    color_size: Size
    depth_size: Size
    units_per_meter: float
    frames: int


@dataclass(frozen=True)
class SensIndex:
    """Where the frames are and what stands beside them; F whole frames, fewer than announced if the file is truncated.

    Attributes:
        poses: float32 [F, 16], `camera_to_world` as stored; minus infinity where unknown.
        times_us: uint64 [F], of the color images.
        offsets: int64 [F], where the color image begins in the file; depth follows it.
        color_bytes: int64 [F].
        depth_bytes: int64 [F].
    """

    poses: np.ndarray
    times_us: np.ndarray
    offsets: np.ndarray
    color_bytes: np.ndarray
    depth_bytes: np.ndarray

    def __len__(self) -> int:
        return len(self.offsets)


class SensFile:
    """A `.sens` file: header and index are read on opening, an image when it is asked for, from any thread.

    Args:
        path: the file.

    Attributes:
        path: as given.
        header: what holds for all frames.
        index: where they are.

    Raises:
        DatasetError: the file is missing, empty, of another version, compressed otherwise than above, truncated in its
            head, or of images that are too large.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        with open_regular(path, DatasetError) as file:
            try:
                self.header = _read_header(file, path)
                self.index = _read_index(file, self.header.frames)
            except OSError as error:
                raise DatasetError(f"{path}: can't be read: {error.strerror}") from error

    def describe(self, frame: int) -> str:
        """What an error about a frame should name."""
        return f"{self.path}, frame {frame}"

    def color(self, frame: int) -> np.ndarray:
        """Color image of a frame, uint8 [H, W, 3], RGB. Raises DatasetError."""
        size, is_raw = self.header.color_size, self.header.color_compression == _RAW
        name, raw_bytes = f"{self.describe(frame)}, color", _COLOR_BYTES * math.prod(size)
        content = self._bytes(self.index.offsets[frame], self.index.color_bytes[frame], raw_bytes, is_raw, name)
        if not is_raw:
            return decode_color(content, name, size)
        return np.frombuffer(content, dtype=np.uint8).reshape(size[1], size[0], _COLOR_BYTES).copy()

    def depth(self, frame: int) -> np.ndarray:
        """Depth image of a frame as stored, uint16 [H, W]. Raises DatasetError."""
        size, is_raw = self.header.depth_size, self.header.depth_compression == _RAW
        name, raw_bytes = f"{self.describe(frame)}, depth", _DEPTH_BYTES * math.prod(size)
        offset = self.index.offsets[frame] + self.index.color_bytes[frame]
        content = self._bytes(offset, self.index.depth_bytes[frame], raw_bytes, is_raw, name)
        if not is_raw:
            content = _inflated(content, raw_bytes, name)
        return np.frombuffer(content, dtype="<u2").reshape(size[1], size[0])

    def _bytes(self, offset: int, count: int, raw_bytes: int, is_raw: bool, name: str) -> bytes:
        """An image's bytes; no more of them are read than an image of its size can need."""
        if is_raw and count != raw_bytes:
            raise DatasetError(f"{name}: must be {raw_bytes} bytes, got {count}")
        most = _MOST_COMPRESSED_SHARE * raw_bytes + _MOST_NOTES_BYTES
        if count > most:
            raise DatasetError(f"{name}: must be at most {most} bytes, got {count}")
        with open_regular(self.path, DatasetError) as file:
            try:
                file.seek(offset)
                content = file.read(count)
            except OSError as error:
                raise DatasetError(f"{self.path}: can't be read: {error.strerror}") from error
        if len(content) < count:
            raise DatasetError(f"{name}: the file is truncated")
        return content


def _inflated(content: bytes, expected: int, name: str) -> bytes:
    """The `expected` bytes that zlib's content stands for; it is never inflated to more than one beyond them."""
    inflater = zlib.decompressobj()
    try:
        inflated = inflater.decompress(content, expected + 1)
    except zlib.error as error:
        raise DatasetError(f"{name}: can't be decompressed: {error}") from error
    if len(inflated) <= expected and not inflater.eof:
        raise DatasetError(f"{name}: can't be decompressed: it ends early")
    if len(inflated) != expected:
        actual = f"over {expected}" if len(inflated) > expected else len(inflated)
        raise DatasetError(f"{name}: must be {expected} bytes, got {actual}")
    return inflated


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
    if color_compression not in (_RAW, _PNG, _JPEG) or depth_compression not in (_RAW, _ZLIB):
        raise DatasetError(
            f"{path}: must contain color as raw, PNG or JPEG (0, 1, 2) and depth as raw or zlib (0, 1), "
            f"got {color_compression} and {depth_compression}"
        )
    sizes = (color_width, color_height), (depth_width, depth_height)
    for size in sizes:
        check_image_size(size, str(path))
    if not is_depth_scale(units_per_meter):
        raise DatasetError(f"{path}: depth_shift must be {DEPTH_SCALE_RULE}, got {units_per_meter}")
    if frames > MAX_FRAMES:
        raise DatasetError(f"{path}: must have at most {MAX_FRAMES} frames, got {frames}")
    return SensHeader(
        sensor, matrices[0], matrices[2], color_compression, depth_compression, *sizes, units_per_meter, frames
    )


def _read_index(file: BinaryIO, frames: int) -> SensIndex:
    """Hops from frame to frame; ends with the last one that is whole."""
    end, offset, heads, offsets = os.fstat(file.fileno()).st_size, file.tell(), bytearray(), []
    for _ in range(frames):
        begin = offset + _FRAME_HEAD.itemsize
        if begin > end:
            break
        file.seek(offset)
        head = file.read(_FRAME_HEAD.itemsize)
        color_bytes, depth_bytes = _FRAME_SIZES.unpack(head[-_FRAME_SIZES.size :])
        offset = begin + color_bytes + depth_bytes
        if offset > end:
            break
        heads += head
        offsets.append(begin)
    table = np.frombuffer(bytes(heads), _FRAME_HEAD)
    return SensIndex(
        table["pose"],
        table["color_time_us"],
        np.array(offsets, dtype=np.int64),
        table["color_bytes"].astype(np.int64),
        table["depth_bytes"].astype(np.int64),
    )


def _unpack(file: BinaryIO, form: str) -> tuple:
    return struct.unpack(form, file.read(struct.calcsize(form)))
