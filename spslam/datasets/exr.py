"""Depth images in OpenEXR files, read by the library of that name."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from spslam.datasets.images import Size, check_image_size
from spslam.errors import DatasetError, brief
from spslam.reading import open_regular

# Where depth is found: in the channel of that name, else in the red one of three alike.
_CHANNELS = ("Z", "Y", "R", "depth", "D")


def read_exr(path: Path, size: Size | None = None) -> np.ndarray:
    """The depth channel of an EXR file.

    Args:
        path: the file.
        size: (width, height) that it must have; None for any that `check_image_size` lets pass.

    Returns:
        float32 [H, W], as stored.

    Raises:
        DatasetError: the library is not installed, or the file is damaged, of another size or without such a channel.
    """
    open_regular(path, DatasetError).close()
    try:
        import OpenEXR
    except ImportError:
        raise DatasetError(f"{path}: EXR images need OpenEXR: pip install 'spslam[phone]'") from None
    try:
        low, high = OpenEXR.File(str(path), header_only=True).header()["dataWindow"]
        _check((int(high[0]) - int(low[0]) + 1, int(high[1]) - int(low[1]) + 1), size, str(path))
        channels = OpenEXR.File(str(path), separate_channels=True).channels()
    except DatasetError:
        raise
    except Exception as error:
        raise DatasetError(f"{path}: can't be read as an EXR image: {brief(str(error) or 'damaged')}") from None
    return _depth(channels, str(path))


def _check(actual: Size, expected: Size | None, name: str) -> None:
    check_image_size(actual, name)
    if expected is not None and actual != expected:
        raise DatasetError(
            f"{name}: must be as large as the recording's first depth image, {expected[0]}x{expected[1]}, "
            f"got {actual[0]}x{actual[1]}"
        )


def _depth(channels: dict[str, Any], name: str) -> np.ndarray:
    found = next((channels[key] for key in _CHANNELS if key in channels), None)
    if found is None and len(channels) == 1:
        found = next(iter(channels.values()))
    if found is None:
        raise DatasetError(f"{name}: must have a channel {', '.join(_CHANNELS)}, got {', '.join(channels)}")
    return np.asarray(found.pixels).astype(np.float32)
