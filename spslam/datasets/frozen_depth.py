"""Detects a frozen depth stream: the same depth image again, with another color image."""

from __future__ import annotations

import zlib
from dataclasses import dataclass

import cv2
import numpy as np

from spslam.datasets.base import RgbdDataset, RgbdFrame
from spslam.errors import DatasetError

FROZEN = "the depth image is the same as in the frame before while the color image changed: the depth stream is frozen"
# Every n-th row is compared: noise makes no two depth images of a sensor alike even there.
_ROW_STEP = 4
_CELLS = (16, 12)
# Mean change of brightness of a cell, in levels of 255. Noise averages out to under a fifth of it, and a hand-held
# camera passes it within one to five frames.
_MOVED_LEVELS = 1.5


@dataclass(frozen=True)
class FrameSignature:
    """What is compared of a frame.

    Attributes:
        depth: checksum of the depth image; 0 without depth.
        brightness: float32 [12, 16], mean brightness of the cells of a grid, less the image's mean.
    """

    depth: int
    brightness: np.ndarray

    @classmethod
    def of(cls, frame: RgbdFrame) -> FrameSignature:
        """The signature of a frame."""
        depth = np.ascontiguousarray(frame.depth[::_ROW_STEP])
        rows = cv2.resize(frame.color[::_ROW_STEP], _CELLS, interpolation=cv2.INTER_AREA)
        cells = cv2.cvtColor(rows, cv2.COLOR_RGB2GRAY)
        brightness = cells.astype(np.float32)
        return cls(zlib.crc32(depth.tobytes()) if depth.any() else 0, brightness - brightness.mean())

    def has_moved_from(self, other: FrameSignature) -> bool:
        """Whether the color images differ by more than noise and exposure, which is a gain and an offset."""
        square = float(np.vdot(other.brightness, other.brightness))
        gain = float(np.vdot(self.brightness, other.brightness)) / max(square, 1.0)
        return float(np.abs(self.brightness - gain * other.brightness).mean()) > _MOVED_LEVELS


class FrozenDepth:
    """Compares each frame with the first one that had the same depth image.

    Args:
        first: of the frames before; None where there are none.
    """

    def __init__(self, first: FrameSignature | None = None) -> None:
        self._first = first

    def check(self, signature: FrameSignature) -> bool:
        """Whether the depth of the next frame is frozen. A camera that stands still before an exact sensor is not."""
        first = self._first
        if first is None or not signature.depth or signature.depth != first.depth:
            self._first = signature
            return False
        return signature.has_moved_from(first)


def frozen_depth_before(dataset: RgbdDataset, start: int) -> FrozenDepth:
    """The state in front of frame `start`, from the frames before it, of which as few are read as possible."""
    first: FrameSignature | None = None
    for index in range(start - 1, -1, -1):
        try:
            signature = FrameSignature.of(dataset[index])
        except DatasetError:
            continue
        if first is not None and signature.depth != first.depth:
            break
        first = signature
        if not signature.depth:
            break
    return FrozenDepth(first)


def frozen_frames(dataset: RgbdDataset, indices: np.ndarray) -> list[int]:
    """Frames whose depth image is that of the frame before, but not their color image.

    Args:
        dataset: to read from; frames that can't be read are left out.
        indices: of the frames before those that are looked at.
    """
    frozen = []
    for index in indices[indices + 1 < len(dataset)]:
        check = FrozenDepth()
        try:
            if any([check.check(FrameSignature.of(dataset[int(i)])) for i in (index, index + 1)]):
                frozen.append(int(index) + 1)
        except DatasetError:
            continue
    return frozen
