"""Images and cameras in ROS messages: `sensor_msgs/Image`, `CompressedImage` and `CameraInfo`."""

from __future__ import annotations

import struct
from typing import Any

import cv2
import numpy as np

from spslam.datasets.calibration_files import lens_model, make_lens
from spslam.datasets.images import Size, check_image_size, decode_color, decode_depth, depth_in_meters
from spslam.datasets.lens import Lens
from spslam.errors import DatasetError, brief

IMAGE, COMPRESSED, CAMERA_INFO = (f"sensor_msgs/msg/{name}" for name in ("Image", "CompressedImage", "CameraInfo"))
_DEPTH_TYPES = {"16uc1": "u2", "mono16": "u2", "32fc1": "f4"}
# Channels of 8 bits, and OpenCV's conversion to RGB.
_COLOR_TYPES: dict[str, tuple[int, int | None]] = {
    "rgb8": (3, None),
    "bgr8": (3, cv2.COLOR_BGR2RGB),
    "8uc3": (3, cv2.COLOR_BGR2RGB),
    "rgba8": (4, cv2.COLOR_RGBA2RGB),
    "bgra8": (4, cv2.COLOR_BGRA2RGB),
    "8uc4": (4, cv2.COLOR_BGRA2RGB),
    "mono8": (1, cv2.COLOR_GRAY2RGB),
    "8uc1": (1, cv2.COLOR_GRAY2RGB),
    "yuv422": (2, cv2.COLOR_YUV2RGB_UYVY),
    "uyvy": (2, cv2.COLOR_YUV2RGB_UYVY),
    "yuv422_yuy2": (2, cv2.COLOR_YUV2RGB_YUY2),
    "yuyv": (2, cv2.COLOR_YUV2RGB_YUY2),
    "yuy2": (2, cv2.COLOR_YUV2RGB_YUY2),
    # OpenCV names a Bayer pattern by its second row's second and third pixel.
    "bayer_rggb8": (1, cv2.COLOR_BayerBG2RGB),
    "bayer_bggr8": (1, cv2.COLOR_BayerRG2RGB),
    "bayer_gbrg8": (1, cv2.COLOR_BayerGR2RGB),
    "bayer_grbg8": (1, cv2.COLOR_BayerGB2RGB),
}
# Of `compressed_depth_image_transport`: the format, and two parameters of inverse depth in 16 bits.
_DEPTH_HEADER = struct.Struct("<iff")


def is_depth(message: Any, topic: str) -> bool:
    """Whether an image message holds depth.

    Args:
        message: `Image` or `CompressedImage`.
        topic: its topic; says so where the message doesn't.
    """
    if hasattr(message, "encoding"):
        encoding = message.encoding.lower()
        return encoding in _DEPTH_TYPES and (encoding != "mono16" or "depth" in topic.lower())
    kind = message.format.lower()
    return "compresseddepth" in kind.replace(" ", "") or kind.startswith(("16uc1", "32fc1"))


def is_colorful(message: Any) -> bool:
    """Whether a color image message has more than one channel."""
    if hasattr(message, "encoding"):
        return message.encoding.lower() not in ("mono8", "8uc1", "mono16")
    return "mono" not in message.format.lower()


def is_readable(message: Any) -> bool:
    """Whether the encoding of an image message is known."""
    return not hasattr(message, "encoding") or message.encoding.lower() in {*_COLOR_TYPES, *_DEPTH_TYPES}


def decode_color_message(message: Any, name: str) -> np.ndarray:
    """The image of a message.

    Args:
        message: `Image` or `CompressedImage`.
        name: what errors begin with.

    Returns:
        uint8 [H, W, 3], RGB.

    Raises:
        DatasetError: an encoding that isn't known, or a damaged image.
    """
    if not hasattr(message, "encoding"):
        return decode_color(bytes(message.data), name)
    encoding = message.encoding.lower()
    if encoding not in _COLOR_TYPES:
        known = ", ".join(_COLOR_TYPES)
        raise DatasetError(f"{name}: the encoding of color must be one of {known}, got {brief(message.encoding)}")
    channels, conversion = _COLOR_TYPES[encoding]
    stored = _rows(message, np.dtype(np.uint8), channels, name)
    image = stored[..., 0] if channels == 1 else stored
    try:
        return image.copy() if conversion is None else cv2.cvtColor(image, conversion)
    except cv2.error as error:  # an odd width of YUV
        raise DatasetError(f"{name}: can't be decoded as {encoding}: {brief(error.err)}") from None


def decode_depth_message(message: Any, name: str, units_per_meter: float | None) -> np.ndarray:
    """The depth image of a message.

    Args:
        message: `Image` or `CompressedImage`.
        name: what errors begin with.
        units_per_meter: None means millimeters in 16 bits and meters in floating point, as ROS prescribes (REP 118).

    Returns:
        float32 [H, W], m, 0 where nothing was measured.

    Raises:
        DatasetError: an encoding that isn't known, or a damaged image.
    """
    if not hasattr(message, "encoding"):
        return _decompressed_depth(message, name, units_per_meter)
    encoding = message.encoding.lower()
    if encoding not in _DEPTH_TYPES:
        raise DatasetError(
            f"{name}: the encoding of depth must be 16UC1, mono16 or 32FC1, got {brief(message.encoding)}"
        )
    order = ">" if message.is_bigendian else "<"
    stored = _rows(message, np.dtype(order + _DEPTH_TYPES[encoding]), 1, name)[..., 0]
    return depth_in_meters(stored.astype(stored.dtype.newbyteorder("=")), units_per_meter)


def camera_of(message: Any, size: Size, is_rectified: bool, name: str) -> Lens:
    """The lens that a `CameraInfo` describes.

    Args:
        message: of ROS 1 or 2.
        size: (width, height) of the images.
        is_rectified: the images are free of distortion already, so that P describes them.
        name: what errors begin with.

    Raises:
        DatasetError: no camera, another shape of image, or a lens model that isn't known.
    """
    fields = {key: getattr(message, key, getattr(message, key.upper(), None)) for key in ("k", "d", "p")}
    matrix = np.asarray(fields["k"], dtype=np.float64).reshape(3, 3)
    projection = np.asarray(fields["p"], dtype=np.float64).reshape(3, 4)[:, :3]
    if is_rectified and projection[0, 0] > 0:
        matrix = projection
    if not matrix[0, 0] > 0:
        raise DatasetError(f"{name}: the camera must be calibrated, got a focal length of {matrix[0, 0]:g}")
    described = int(message.width) or size[0], int(message.height) or size[1]
    check_image_size(described, name)
    if abs(described[0] * size[1] - described[1] * size[0]) > max(*described, *size):
        raise DatasetError(
            f"{name}: must describe images of {size[0]}x{size[1]}, got {described[0]}x{described[1]}; "
            "a camera that crops its images is not supported"
        )
    coefficients = [] if is_rectified else [float(value) for value in np.asarray(fields["d"]).reshape(-1)]
    model = lens_model(message.distortion_model if any(coefficients) else "", name)
    lens = make_lens(matrix, described, model, coefficients, name)
    return Lens(lens.camera.resized(*size), lens.model, lens.coefficients)


def _rows(message: Any, kind: np.dtype, channels: int, name: str) -> np.ndarray:
    """The pixels [H, W, C] of an `Image`, whose rows may be padded."""
    width, height, step = int(message.width), int(message.height), int(message.step)
    check_image_size((width, height), name)
    needed = width * channels * kind.itemsize
    content = np.asarray(message.data, dtype=np.uint8)
    step = step or needed
    if step < needed or content.size < step * (height - 1) + needed:
        raise DatasetError(
            f"{name}: an image of {width}x{height} must have {needed * height} bytes, got {content.size} in rows of "
            f"{step}"
        )
    rows = np.lib.stride_tricks.as_strided(content, (height, needed), (step, 1), writeable=False)
    return np.ascontiguousarray(rows).view(kind).reshape(height, width, channels)


def _decompressed_depth(message: Any, name: str, units_per_meter: float | None) -> np.ndarray:
    content, kind = bytes(message.data), message.format.lower().replace(" ", "")
    if "compresseddepth" not in kind:  # a PNG of 16 bits, by the transport for color
        return decode_depth(content, name, units_per_meter)
    if "rvl" in kind:
        raise DatasetError(f"{name}: depth compressed as RVL can't be read; republish it with format png")
    if len(content) < _DEPTH_HEADER.size:
        raise DatasetError(f"{name}: the image is truncated ({len(content)} bytes)")
    _, quant_a, quant_b = _DEPTH_HEADER.unpack_from(content)
    image = content[_DEPTH_HEADER.size :]
    if not kind.startswith("32fc1"):
        return decode_depth(image, name, units_per_meter)
    stored = decode_depth(image, name, 1.0)
    with np.errstate(divide="ignore", invalid="ignore"):
        depth = np.float32(quant_a) / (stored - np.float32(quant_b))
    depth[stored == 0] = 0
    return depth_in_meters(depth, units_per_meter)
