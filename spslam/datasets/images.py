"""Decoding color and depth images; every failure names the file.

The size in an image's header is held against what is expected before anything is decoded: a PNG of 2.6 MB can hold
30000 x 30000 pixels.
"""

from __future__ import annotations

import io
import math
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from spslam.datasets.image_header import image_size, is_truncated
from spslam.datasets.png import decode_png
from spslam.errors import DatasetError, brief
from spslam.reading import read_bytes

# Of an image whose size isn't known beforehand; about 17 million pixels. Pixel records have 16 bits for a coordinate.
MAX_PIXELS, MAX_SIDE_PX = 1 << 24, 1 << 15
# Of an image's file.
MAX_IMAGE_BYTES = 8 * MAX_PIXELS
_DEPTH_TYPES = (np.uint16, np.float32, np.float64)

# Depth units per meter that make sense: of nanometers up to ones of a kilometer.
_LEAST_UNITS, _MOST_UNITS = 1e-3, 1e9
DEPTH_SCALE_RULE = f"a number from {_LEAST_UNITS:g} to {_MOST_UNITS:g}"

# Where a recording is looked at for the size of its images, as shares of its length, and how many alike are enough.
_LOOKED_AT, _ENOUGH_ALIKE = (0.0, 0.5, 1.0, 0.25, 0.75), 3

Size = tuple[int, int]


def read_color(path: Path, size: Size | None = None) -> np.ndarray:
    """Reads a color image.

    Args:
        path: a PNG, JPEG or TIFF. A rotation noted in EXIF is ignored: the depth image beside it isn't rotated either.
        size: (width, height) that it must have; None for any that `check_image_size` lets pass.

    Returns:
        uint8 [H, W, 3], RGB; gray images are repeated over the channels.

    Raises:
        DatasetError: the file is missing, truncated, no image, or of another size.
    """
    return decode_color(_image_bytes(path), str(path), size)


def decode_color(content: bytes, name: str, size: Size | None = None) -> np.ndarray:
    """As `read_color`, from an image file's bytes.

    Args:
        content: of the file.
        name: what errors name.
        size: see `read_color`.
    """
    _check_content(content, name, size)
    image = decode_png(content, channels=3)
    if image is None:
        image = _decode(content, name, cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)
        cv2.cvtColor(image, cv2.COLOR_BGR2RGB, dst=image)
    return image


def read_depth(
    path: Path, units_per_meter: float | None, invalid: Sequence[int] = (), size: Size | None = None
) -> np.ndarray:
    """Reads a depth image.

    Args:
        path: an image with one channel, 16-bit (PNG, TIFF) or 32-bit float (TIFF), or a two-dimensional `.npy`.
        units_per_meter: the stored value of one meter; None means millimeters in 16 bits, meters in floating point.
        invalid: stored values besides 0 that stand for "not measured". Negative and non-finite ones always do.
        size: (width, height) that it must have; None for any that `check_image_size` lets pass.

    Returns:
        float32 [H, W], m, 0 where nothing was measured.

    Raises:
        DatasetError: the file is missing, truncated, not an image, of another kind (8-bit, several channels), or of
            another size.
    """
    if path.suffix.lower() == ".npy":
        stored = _load_array(path, size)
    else:
        stored = _decode_stored(_image_bytes(path), str(path), size)
    return _checked_depth(stored, str(path), units_per_meter, invalid)


def decode_depth(
    content: bytes, name: str, units_per_meter: float | None, size: Size | None = None, invalid: Sequence[int] = ()
) -> np.ndarray:
    """As `read_depth`, from an image file's bytes.

    Args:
        content: of the file.
        name: what errors name.
        units_per_meter: see `read_depth`.
        size: see `read_depth`.
        invalid: see `read_depth`.
    """
    return _checked_depth(_decode_stored(content, name, size), name, units_per_meter, invalid)


def read_confidence(path: Path, size: Size) -> np.ndarray:
    """Reads a confidence map.

    Args:
        path: an image with one channel of 8 bits; 0 is the lowest confidence.
        size: (width, height) that it must have.

    Returns:
        uint8 [H, W].

    Raises:
        DatasetError: as `read_color`, or several channels, or more bits.
    """
    stored = _decode_stored(_image_bytes(path), str(path), size)
    if stored.ndim != 2 or stored.dtype != np.uint8:
        raise DatasetError(
            f"{path}: confidence must be 8-bit with one channel, got {stored.dtype} {list(stored.shape)}"
        )
    return stored


def depth_in_meters(stored: np.ndarray, units_per_meter: float | None, invalid: Sequence[int] = ()) -> np.ndarray:
    """Converts stored depth to meters.

    Args:
        stored: uint16 or floating-point [H, W].
        units_per_meter: see `read_depth`.
        invalid: see `read_depth`.

    Returns:
        float32 [H, W], m, 0 where nothing was measured.
    """
    if units_per_meter is None:
        units_per_meter = 1000.0 if stored.dtype == np.uint16 else 1.0
    if stored.dtype == np.uint16:
        # Factors of 0 and 1, and a conversion of its own: masks and mixed types take twice as long.
        for value in invalid:
            stored = stored * (stored != value).astype(np.uint16)
        depth = stored.astype(np.float32)
        depth /= np.float32(units_per_meter)
        return depth
    with np.errstate(over="ignore", invalid="ignore"):  # infinity and NaN are not measured
        depth = np.divide(stored, np.float32(units_per_meter), dtype=np.float32, casting="same_kind")
    for value in invalid:
        depth[stored == value] = 0
    depth[~np.isfinite(depth) | (depth < 0)] = 0
    return depth


def check_image_size(size: Size, name: str) -> None:
    """Raises DatasetError, which begins with `name`, for an image (width, height) that is empty or too large."""
    if not (min(size) > 0 and max(size) <= MAX_SIDE_PX and math.prod(size) <= MAX_PIXELS):
        raise DatasetError(
            f"{name}: an image must have 1 to {MAX_PIXELS} pixels and at most {MAX_SIDE_PX} along a side, "
            f"got {_text(size)}"
        )


def is_depth_scale(units_per_meter: Any) -> bool:
    """Whether something is a number that can be the stored value of one meter."""
    if not isinstance(units_per_meter, (int, float)) or isinstance(units_per_meter, bool):
        return False
    return _LEAST_UNITS <= units_per_meter <= _MOST_UNITS


def first_size(paths: Iterable[Path], read: Callable[[Path], np.ndarray] = read_color) -> Size:
    """The size of the first image that can be read.

    Args:
        paths: the images.
        read: reads one of them.

    Returns:
        (width, height).

    Raises:
        DatasetError: none can be read; the first one's error.
    """
    first_error = None
    for path in paths:
        try:
            height, width = read(path).shape[:2]
        except DatasetError as error:
            first_error = first_error or error
        else:
            return width, height
    raise first_error or DatasetError("first_size: paths must not be empty, got none")


def usual_size(paths: Sequence[Path], read: Callable[[Path], np.ndarray] = read_color) -> tuple[Size, dict[Path, str]]:
    """The size of most images, by a few that are spread over the recording, so that an odd one is told from the others.

    Args:
        paths: the images in order.
        read: reads one of them.

    Returns:
        (width, height), of sizes that are as frequent the first one's; and what is wrong with images of another one.

    Raises:
        DatasetError: as `first_size`.
    """
    sizes: dict[Path, Size] = {}
    for number in dict.fromkeys(round(share * (len(paths) - 1)) for share in _LOOKED_AT):
        if len(sizes) >= _ENOUGH_ALIKE and len(set(sizes.values())) == 1:
            break
        try:
            height, width = read(paths[number]).shape[:2]
        except DatasetError:
            continue
        sizes[paths[number]] = width, height
    found = list(sizes.values())
    usual = max(found, key=found.count) if found else first_size(paths, read)
    rule = f"must be as large as most images of the recording, {_text(usual)}"
    return usual, {path: f"{path}: {rule}, got {_text(size)}" for path, size in sizes.items() if size != usual}


def resized_color(color: np.ndarray, width: int, height: int) -> np.ndarray:
    """A color image of the same view in another size; larger ones are averaged, smaller ones interpolated."""
    if color.shape[:2] == (height, width):
        return color
    shrinks = color.shape[0] >= height and color.shape[1] >= width
    return cv2.resize(color, (width, height), interpolation=cv2.INTER_AREA if shrinks else cv2.INTER_LINEAR)


def _checked_depth(stored: np.ndarray, name: str, units_per_meter: float | None, invalid: Sequence[int]) -> np.ndarray:
    if stored.ndim != 2 or stored.dtype not in _DEPTH_TYPES:
        channels = 1 if stored.ndim == 2 else stored.shape[-1]
        raise DatasetError(
            f"{name}: depth must be uint16, float32 or float64 with one channel, got {stored.dtype} with {channels}"
        )
    return depth_in_meters(stored, units_per_meter, invalid)


def _decode_stored(content: bytes, name: str, size: Size | None) -> np.ndarray:
    """The numbers as they are stored, [H, W] where there is one channel."""
    _check_content(content, name, size)
    stored = decode_png(content, channels=1)
    return _decode(content, name, cv2.IMREAD_UNCHANGED) if stored is None else stored


def _check_content(content: bytes, name: str, size: Size | None) -> None:
    """Raises DatasetError where a file can't be decoded as its end is missing, or for the size in its header."""
    # Checked beforehand because some versions of OpenCV return the half they could decode.
    if is_truncated(content):
        raise DatasetError(f"{name}: the image is truncated ({len(content)} bytes, no end mark)")
    try:
        actual = image_size(content)
    except ValueError as error:
        raise DatasetError(f"{name}: can't be decoded as an image: {error}") from None
    _check_size(actual, size, name)


def _decode(content: bytes, name: str, flags: int) -> np.ndarray:
    try:
        image = cv2.imdecode(np.frombuffer(content, dtype=np.uint8), flags)
    except cv2.error as error:
        raise DatasetError(f"{name}: can't be decoded as an image: {error.err}") from error
    if image is None:
        raise DatasetError(f"{name}: can't be decoded as an image")
    return image


def _check_size(actual: Size, expected: Size | None, name: str) -> None:
    if expected is not None and actual != expected:
        raise DatasetError(
            f"{name}: must be as large as the sequence's first image, {_text(expected)}, got {_text(actual)}"
        )
    check_image_size(actual, name)


def _text(size: Size) -> str:
    return brief(f"{size[0]}x{size[1]}")


def _load_array(path: Path, size: Size | None) -> np.ndarray:
    """The array [H, W] in a `.npy` file; its header is checked before anything is allocated."""
    content = _image_bytes(path)
    file = io.BytesIO(content)
    try:
        version = np.lib.format.read_magic(file)
        read_header = {(1, 0): np.lib.format.read_array_header_1_0, (2, 0): np.lib.format.read_array_header_2_0}
        shape, fortran_order, dtype = read_header[version](file)
    except Exception as error:  # NumPy parses the header as Python and raises whatever that raises
        raise DatasetError(
            f"{path}: can't be read as an array: {brief(str(error) or 'its header is damaged')}"
        ) from None
    if len(shape) != 2 or min(shape) < 1 or dtype.type not in _DEPTH_TYPES:
        raise DatasetError(
            f"{path}: depth must be uint16, float32 or float64 [H, W], got {brief(str(dtype))} {brief(list(shape))}"
        )
    height, width = map(int, shape)  # True counts as a number in NumPy's headers
    _check_size((width, height), size, str(path))
    start = file.tell()
    if len(content) - start < height * width * dtype.itemsize:
        raise DatasetError(f"{path}: the array is truncated ({len(content)} bytes)")
    stored = np.frombuffer(content, dtype, height * width, start).reshape(
        (height, width), order="F" if fortran_order else "C"
    )
    return np.ascontiguousarray(stored, dtype.newbyteorder("="))


def _image_bytes(path: Path) -> bytes:
    content = read_bytes(path, MAX_IMAGE_BYTES, DatasetError)
    if not content:
        raise DatasetError(f"{path}: the file is empty")
    return content
