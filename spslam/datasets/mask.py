"""Which pixels of a recording's images are left out: by an image of the user's, or as they move with the camera."""

from __future__ import annotations

import os
from pathlib import Path

import cv2
import numpy as np

from spslam.camera import Camera
from spslam.datasets.base import RgbdDataset
from spslam.datasets.carried import find_carried
from spslam.errors import DatasetError

NO_MASK = "none"


def read_mask(path: str | os.PathLike, camera: Camera) -> np.ndarray:
    """The pixels that a mask leaves out, bool [H, W]: the black ones.

    Args:
        path: an image of the size of the camera's.
        camera: of the recording.

    Raises:
        DatasetError: the file is missing, is no image, is of another size, or leaves nothing.
    """
    path = Path(path)
    if not path.is_file():
        raise DatasetError(f"dataset.mask: {path} does not exist; `dataset.mask=none` uses all pixels")
    image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    if image is None:
        raise DatasetError(f"dataset.mask: {path} is not an image that can be read")
    if image.shape[:2] != (camera.height, camera.width):
        raise DatasetError(
            f"dataset.mask: {path} must be as large as the recording's images, {camera.width}x{camera.height}, got "
            f"{image.shape[1]}x{image.shape[0]}"
        )
    left_out = image == 0 if image.ndim == 2 else (image[..., :3] == 0).all(axis=2)
    if left_out.all():
        raise DatasetError(f"dataset.mask: {path} is black; black pixels are left out, and some must be left")
    return left_out


def left_out_by(mask: str | None, camera: Camera) -> np.ndarray | None:
    """As `read_mask`, or None where the option names no image."""
    return None if mask in (None, NO_MASK) else read_mask(str(mask), camera)


def absolute_mask(mask: str | None) -> str | None:
    """The option as it holds in any working directory."""
    return mask if mask in (None, NO_MASK) else os.path.abspath(mask)


def apply_mask(dataset: RgbdDataset, mask: str | None) -> None:
    """Leaves out what `dataset.mask` says of a dataset that was just opened.

    Args:
        dataset: changed. Where frames far apart are read as fast as others, what moves along with the camera is found.
        mask: path of an image, `none`, or None to find out.
    """
    if mask is not None:
        dataset.left_out = left_out_by(mask, dataset.camera)
    elif dataset.is_random_access or dataset.is_seekable:
        dataset.left_out = find_carried(dataset)
        if dataset.left_out is not None:
            dataset.remarks = (*dataset.remarks, carried_remark(dataset.left_out))


def carried_remark(left_out: np.ndarray) -> str:
    """What is said of pixels bool [H, W] that were found to move along."""
    return f"{left_out.mean():.0%} of the image moves along with the camera and is left out (dataset.mask=none uses it)"
