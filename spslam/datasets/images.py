"""Decoding color and depth images; every failure names the file."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from pathlib import Path

import cv2
import numpy as np

from spslam.errors import DatasetError

# A PNG ends with its IEND chunk and a JPEG with the marker FF D9; some writers add a few bytes of padding.
_END_MARKS = {".png": b"IEND", ".jpg": b"\xff\xd9", ".jpeg": b"\xff\xd9"}
_TAIL_BYTES = 1024


def read_color(path: Path) -> np.ndarray:
    """The image as uint8 [H,W,3], RGB; gray images are repeated over the channels.

    A rotation noted in EXIF is ignored: the depth image beside it isn't rotated either. Raises DatasetError.
    """
    return decode_color(_read_bytes(path), path.suffix, str(path))


def decode_color(content: bytes, suffix: str, name: str) -> np.ndarray:
    """As :func:`read_color` from an image file's bytes; ``suffix`` says which kind, ``name`` is what errors name."""
    image = _decode(content, suffix, name, cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)
    return cv2.cvtColor(image, cv2.COLOR_BGR2RGB, dst=image)


def read_depth(path: Path, units_per_meter: float | None, invalid: Sequence[int] = ()) -> np.ndarray:
    """The depth image as float32 [H,W] in meters, 0 where nothing was measured.

    Parameters
    ----------
    path : a one-channel image, 16-bit (PNG, TIFF) or 32-bit float (TIFF), or a two-dimensional ``.npy``.
    units_per_meter : the stored value of one meter; None means millimeters in 16 bits, meters in floating point.
    invalid : stored values besides 0 that stand for "not measured". Negative and non-finite ones always do.

    Raises
    ------
    DatasetError
        For a file that is missing, truncated, not an image, or of another kind (8-bit, several channels).
    """
    if path.suffix == ".npy":
        stored = _load_array(path)
    else:
        stored = _decode(_read_bytes(path), path.suffix, str(path), cv2.IMREAD_UNCHANGED)
    if stored.ndim != 2 or stored.dtype not in (np.uint16, np.float32, np.float64):
        channels = 1 if stored.ndim == 2 else stored.shape[-1]
        raise DatasetError(
            f"{path}: depth must be 16-bit or floating-point with one channel, got {stored.dtype} with {channels}"
        )
    return depth_in_meters(stored, units_per_meter, invalid)


def depth_in_meters(stored: np.ndarray, units_per_meter: float | None, invalid: Sequence[int] = ()) -> np.ndarray:
    """Stored depth [H,W], uint16 or floating-point, as float32 meters; arguments as for :func:`read_depth`."""
    if units_per_meter is None:
        units_per_meter = 1000.0 if stored.dtype == np.uint16 else 1.0
    depth = np.divide(stored, np.float32(units_per_meter), dtype=np.float32, casting="same_kind")
    for value in invalid:
        depth[stored == value] = 0
    if stored.dtype != np.uint16:
        depth[~np.isfinite(depth) | (depth < 0)] = 0
    return depth


def first_size(paths: Iterable[Path], read: Callable[[Path], np.ndarray] = read_color) -> tuple[int, int]:
    """(width, height) of the first image that ``read`` can read; raises the first one's DatasetError if none."""
    first_error = None
    for path in paths:
        try:
            height, width = read(path).shape[:2]
        except DatasetError as error:
            first_error = first_error or error
        else:
            return width, height
    raise first_error or DatasetError("first_size: paths must not be empty, got none")


def resized_color(color: np.ndarray, width: int, height: int) -> np.ndarray:
    """A color image of the same view in another size; larger ones are averaged, smaller ones interpolated."""
    if color.shape[:2] == (height, width):
        return color
    shrinks = color.shape[0] >= height and color.shape[1] >= width
    return cv2.resize(color, (width, height), interpolation=cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR)


def _decode(content: bytes, suffix: str, name: str, flags: int) -> np.ndarray:
    mark = _END_MARKS.get(suffix.lower())
    # Checked beforehand because some versions of OpenCV return the half they could decode.
    if mark is not None and mark not in content[-_TAIL_BYTES:] and mark not in content[len(content) // 2 :]:
        raise DatasetError(f"{name}: the image is truncated ({len(content)} bytes, no end mark)")
    try:
        image = cv2.imdecode(np.frombuffer(content, dtype=np.uint8), flags)
    except cv2.error as error:
        raise DatasetError(f"{name}: can't be decoded as an image: {error.err}") from error
    if image is None:
        raise DatasetError(f"{name}: can't be decoded as an image")
    return image


def _load_array(path: Path) -> np.ndarray:
    try:
        return np.load(path, allow_pickle=False)
    except (OSError, ValueError, EOFError) as error:
        raise DatasetError(f"{path}: can't be read as an array: {error}") from error


def _read_bytes(path: Path) -> bytes:
    try:
        content = path.read_bytes()
    except FileNotFoundError:
        raise DatasetError(f"{path}: no such file") from None
    except OSError as error:
        raise DatasetError(f"{path}: can't be read: {error.strerror}") from error
    if not content:
        raise DatasetError(f"{path}: the file is empty")
    return content
