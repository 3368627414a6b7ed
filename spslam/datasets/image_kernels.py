"""Compiled functions on images as they are read."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from spslam.image_library import image_library

_CHANNELS = 3
_MOST_BYTES = 2**31 - 1  # places in an image are 32-bit numbers
_NO_MEMORY = 1  # returned by compiled functions


@dataclass(frozen=True)
class ColorView:
    """How a color camera sees what a depth camera measures.

    Attributes:
        color_size: width and height of the color image, px, at least 1.
        depth_size: those of the depth image.
        cells: those of the depth buffer of the color camera's view; 0 and 0 where nothing can hide from it.
        pixel_map: float64 [3, 4], times (z u, z v, z, 1) of a depth pixel (u, v) of depth z (m) it gives (w x, w y, w):
            the pixel (x, y) of the color image and the depth w (m) from there.
    """

    color_size: tuple[int, int]
    depth_size: tuple[int, int]
    cells: tuple[int, int]
    pixel_map: np.ndarray


def register_color(
    view: ColorView,
    color: np.ndarray,
    depth: np.ndarray,
    unseen: np.ndarray | None,
    typical_depth: float,
    hidden_share: float,
    in_place: bool = False,
) -> tuple[np.ndarray, np.ndarray]:
    """Gives each pixel of a depth image its color; releases Python's lock meanwhile.

    Args:
        view: the cameras.
        color: uint8 [Hc, Wc, 3].
        depth: float32 [H, W], m; what is not above 0 is unknown.
        unseen: uint8 [Hc, Wc], not 0 where the color image has no content; None for none.
        typical_depth: of pixels without depth, m: their color is looked for there.
        hidden_share: a point is hidden if another one falls into its cell of the depth buffer, or one beside, and is
            nearer by this share.
        in_place: write depth into `depth`, if that is contiguous: the fresh memory of one more image costs nearly as
            much as all of this, where the heap has to grow for it.

    Returns:
        uint8 [H, W, 3] colors, interpolated linearly, those of the border beyond it; and float32 [H, W] depth, 0 where
        the color camera does not see the point. Deterministic; instruction sets differ by rounding.

    Raises:
        ValueError: an image of another shape or dtype, or a color image of 2 GB or more.
        ImportError: there is no compiled library for this processor.
        MemoryError: there is not enough of it.
    """
    color = _checked("color", color, np.uint8, (*view.color_size[::-1], _CHANNELS))
    if color.nbytes > _MOST_BYTES:
        raise ValueError(f"register_color: color must have at most {_MOST_BYTES} bytes, got {color.nbytes}")
    colors = np.empty((*view.depth_size[::-1], _CHANNELS), np.uint8)
    return colors, _register(view, (color, colors), depth, unseen, (typical_depth, hidden_share), in_place)


def seen_depth(
    view: ColorView, depth: np.ndarray, unseen: np.ndarray | None, hidden_share: float, in_place: bool = False
) -> np.ndarray:
    """The depth that `register_color` returns, without a color image; arguments and errors as there."""
    typical_m = 1.0  # where a pixel without depth finds its color, of which there is none
    return _register(view, (None, None), depth, unseen, (typical_m, hidden_share), in_place)


def _register(
    view: ColorView,
    colors: tuple[np.ndarray | None, np.ndarray | None],
    depth: np.ndarray,
    unseen: np.ndarray | None,
    numbers: tuple[float, float],
    in_place: bool,
) -> np.ndarray:
    """Depth that the color camera sees; writes the second of `colors` from the first where there are any."""
    depth = _checked("depth", depth, np.float32, view.depth_size[::-1])
    if unseen is not None:
        unseen = _checked("unseen", unseen, np.uint8, view.color_size[::-1])
    kept = depth if in_place else np.empty_like(depth)
    sizes = np.array([*view.color_size, *view.depth_size, *view.cells], np.int32)
    constants = np.array([*view.pixel_map.T.ravel(), *numbers], np.float32)
    color, registered = colors
    arrays = color, unseen, depth, sizes, constants, registered, kept
    if image_library().spslam_register_color(*(None if array is None else array.ctypes.data for array in arrays)):
        raise MemoryError("register_color: not enough memory for images of this size")
    return kept


def unfilter_png(filtered: bytes, shape: tuple[int, int], channels: int, bits: int) -> np.ndarray | None:
    """Undoes the filters of a PNG's rows, as its inflated data have them; releases Python's lock meanwhile.

    Args:
        filtered: of each row the number of its filter, and then its pixels.
        shape: rows and columns of the image, which is not interlaced.
        channels: of a pixel, 1 to 4; one only with 16 bits.
        bits: of a channel, 8 or 16.

    Returns:
        uint8 or uint16 [H, W], or [H, W, C] of several channels; None where a row's filter is none that there is.

    Raises:
        ValueError: there are not as many bytes as such an image has.
        ImportError, MemoryError: as `register_color`.
    """
    (rows, columns), pixel_bytes = shape, channels * bits // 8
    row_bytes = columns * pixel_bytes
    if len(filtered) != rows * (1 + row_bytes) or not 1 <= pixel_bytes <= 4 or rows * row_bytes > _MOST_BYTES:
        raise ValueError(f"unfilter_png: not an image {[rows, columns, channels]} of {bits} bits")
    image = np.empty((rows, columns) if channels == 1 else (rows, columns, channels), np.dtype(f"u{bits // 8}"))
    sizes = np.array([rows, row_bytes, pixel_bytes], np.int32)
    failure = image_library().spslam_unfilter_png(filtered, sizes.ctypes.data, int(bits == 16), image.ctypes.data)
    if failure == _NO_MEMORY:
        raise MemoryError("unfilter_png: not enough memory for an image of this size")
    return None if failure else image


def _checked(name: str, image: np.ndarray, dtype: type, shape: tuple[int, ...]) -> np.ndarray:
    if image.dtype != dtype or image.shape != shape:
        wanted = f"{np.dtype(dtype).name} {list(shape)}"
        raise ValueError(f"register_color: {name} must be {wanted}, got {image.dtype} {list(image.shape)}")
    return np.ascontiguousarray(image)
