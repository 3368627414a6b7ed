"""Frames from arrays of the user's own, with checks that name the mistake: type, shape, unit, axes or time."""

from __future__ import annotations

import math
from numbers import Real
from typing import TYPE_CHECKING, Any

import numpy as np

if TYPE_CHECKING:
    from spslam.camera import Camera

# `RgbdFrame.index` of a frame that the system numbers itself.
UNNUMBERED = -1
# The median of an image in meters: nearer than any depth camera measures, and farther than any does.
MEDIAN_RANGE_M = (0.01, 100.0)
# Unix time in seconds passes this in the year 5138; in milliseconds it did so in 1973.
MAX_TIMESTAMP_S = 1e11
MAX_COLOR_OFFSET_S = 1.0  # farther apart, images are of two frames; or milliseconds were meant
# Every n-th row and column decides about units.
_STEP_PX = 8
_COMMON_SCALES = (1000.0, 5000.0, 10000.0)


def checked_arrays(
    color: Any, depth: Any, timestamp: float, depth_scale: float | None
) -> tuple[np.ndarray, np.ndarray, float]:
    """The arrays of a frame as `RgbdFrame` holds them; see `RgbdFrame.from_arrays` for arguments and errors."""
    color_image, stored = np.asarray(color), np.asarray(depth)
    _check_color(color_image)
    _check_depth(stored)
    _check_sizes(color_image, stored)
    depth_m = _in_meters(stored, depth_scale)
    _check_unit(depth_m, stored.dtype, depth_scale)
    return np.ascontiguousarray(color_image), depth_m, _checked_time(timestamp)


def checked_offset(color_offset: float) -> float:
    """`color_offset` of `RgbdFrame.from_arrays` (s), checked; TypeError or ValueError where it is none."""
    name = "RgbdFrame.from_arrays: color_offset"
    if not isinstance(color_offset, Real) or isinstance(color_offset, bool):
        raise TypeError(f"{name} must be a number of seconds, got {type(color_offset).__name__}")
    if not abs(float(color_offset)) <= MAX_COLOR_OFFSET_S:
        raise ValueError(f"{name} must be within {MAX_COLOR_OFFSET_S:g} s of the depth image, got {color_offset}")
    return float(color_offset)


def check_frame(function: str, color: np.ndarray, depth: np.ndarray, camera: Camera) -> None:
    """Checks type and size of a frame's images; costs nothing that grows with them.

    Args:
        function: what messages begin with.
        color: must be uint8 [H, W, 3] of the camera's size.
        depth: must be floating-point [H, W] of the camera's size.
        camera: of the frame.

    Raises:
        TypeError: another dtype.
        ValueError: another shape.
    """
    size = camera.height, camera.width
    hint = "; RgbdFrame.from_arrays converts and checks arrays"
    for name, image, wanted, shape in (
        ("color", color, "uint8", (*size, 3)),
        ("depth", depth, "floating-point meters", size),
    ):
        got = image.dtype if isinstance(image, np.ndarray) else type(image).__name__
        is_right = got == np.uint8 if name == "color" else getattr(got, "kind", None) == "f"
        if not is_right:
            raise TypeError(f"{function}: {name} must be an array of {wanted}, got {got}{hint}")
        if image.shape != shape:
            raise ValueError(f"{function}: {name} must have the camera's shape {shape}, got {image.shape}")


def check_time(function: str, timestamp: float) -> None:
    """Checks a frame's time stamp, of which motion between frames is predicted.

    Args:
        function: what messages begin with.
        timestamp: must be a finite number, s.

    Raises:
        TypeError: no number.
        ValueError: NaN or infinity.
    """
    if not isinstance(timestamp, Real):
        raise TypeError(f"{function}: timestamp must be a number of seconds, got {type(timestamp).__name__}")
    if not math.isfinite(timestamp):
        raise ValueError(f"{function}: timestamp must be a finite number of seconds, got {timestamp}")


def _check_color(color: np.ndarray) -> None:
    name = "RgbdFrame.from_arrays: color"
    if color.dtype != np.uint8:
        hint = "; multiply colors from 0 to 1 by 255 first" if color.dtype.kind == "f" else ""
        raise TypeError(f"{name} must be uint8 [H, W, 3] RGB, got {color.dtype} {list(color.shape)}{hint}")
    if color.ndim == 3 and color.shape[2] == 3 and min(color.shape[:2]) > 0:
        return
    hint = ""
    if color.ndim == 2 or (color.ndim == 3 and color.shape[2] == 1):
        hint = "; repeat a gray image over three channels"
    elif color.ndim == 3 and color.shape[2] == 4:
        hint = "; leave out the fourth channel, color[..., :3]"
    elif color.ndim == 3 and color.shape[0] == 3:
        hint = "; the channels come last, color.transpose(1, 2, 0)"
    raise ValueError(f"{name} must have shape [H, W, 3], got {list(color.shape)}{hint}")


def _check_depth(depth: np.ndarray) -> None:
    name = "RgbdFrame.from_arrays: depth"
    if depth.dtype.kind not in "uif" or depth.dtype == np.uint8:
        raise TypeError(f"{name} must be floating-point meters or whole numbers of 16 bits or more, got {depth.dtype}")
    if depth.ndim != 2 or min(depth.shape) == 0:
        hint = "; depth[..., 0] takes the channel" if depth.ndim == 3 and depth.shape[2] == 1 else ""
        raise ValueError(f"{name} must have shape [H, W], got {list(depth.shape)}{hint}")


def _check_sizes(color: np.ndarray, depth: np.ndarray) -> None:
    if color.shape[:2] != depth.shape:
        raise ValueError(
            f"RgbdFrame.from_arrays: depth must be as large as color, {list(color.shape[:2])}, got "
            f"{list(depth.shape)}; both must be of the same view (depth registered to color)"
        )


def _in_meters(stored: np.ndarray, depth_scale: float | None) -> np.ndarray:
    """float32 meters, 0 where nothing was measured."""
    if depth_scale is None:
        if stored.dtype.kind != "f":
            raise ValueError(
                f"RgbdFrame.from_arrays: depth of {stored.dtype} needs depth_scale, its units per meter: "
                "1000 for millimeters"
            )
        depth_scale = 1.0
    if isinstance(depth_scale, bool) or not (isinstance(depth_scale, Real) and 0 < depth_scale < math.inf):
        raise ValueError(f"RgbdFrame.from_arrays: depth_scale must be a number above 0, got {depth_scale!r}")
    with np.errstate(over="ignore", invalid="ignore"):
        depth = np.divide(stored, np.float32(depth_scale), dtype=np.float32, casting="unsafe")
        depth[~((depth > 0) & (depth < np.inf))] = 0
    return depth


def _check_unit(depth: np.ndarray, dtype: np.dtype, depth_scale: float | None) -> None:
    sample = depth[::_STEP_PX, ::_STEP_PX]
    measured = sample[sample > 0]
    if not measured.size:
        return
    median, (low, high) = float(np.median(measured)), MEDIAN_RANGE_M
    if low <= median <= high:
        return
    units = median * (depth_scale or 1.0)
    fitting = [f"{scale:g}" for scale in _COMMON_SCALES if 0.3 <= units / scale <= 10]
    suggestion = f"; depth_scale={' or '.join(fitting)} would fit" if fitting else ""
    raise ValueError(
        f"RgbdFrame.from_arrays: depth must be in meters with a median from {low:g} to {high:g} m, got {dtype} with a "
        f"median of {median:.4g} m at depth_scale={depth_scale or 1:g}{suggestion}"
    )


def _checked_time(timestamp: float) -> float:
    try:
        seconds = float(timestamp)
    except (TypeError, ValueError):
        seconds = math.nan
    if not abs(seconds) < MAX_TIMESTAMP_S:
        raise ValueError(
            f"RgbdFrame.from_arrays: timestamp must be in seconds, at most {MAX_TIMESTAMP_S:g}, got {timestamp!r}"
        )
    return seconds
