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
_DEPTH_ROW_STEP, _COLOR_ROW_STEP = 8, 4
_CELLS = (16, 12)
# Mean change of brightness of a cell, in levels of 255. Noise averages out to under a fifth of it, and a hand-held
# camera passes it within one to five frames.
_MOVED_LEVELS = 1.5


@dataclass(frozen=True)
class FrameSignature:
    """What is compared of a frame; kept, or sent to another process, without it.

    Attributes:
        depth: checksum of the depth image; 0 without depth.
        brightness: float32 [12, 16], mean brightness of the cells of a grid, less the image's mean.
    """

    depth: int
    brightness: np.ndarray

    @classmethod
    def of(cls, frame: RgbdFrame) -> FrameSignature:
        """The signature of a frame."""
        return cls(_checksum(frame.depth), _brightness(frame.color[::_COLOR_ROW_STEP]))


def _checksum(depth: np.ndarray) -> int:
    rows = np.ascontiguousarray(depth[::_DEPTH_ROW_STEP])
    return zlib.crc32(rows.data) if rows.any() else 0


def _brightness(rows: np.ndarray) -> np.ndarray:
    cells = cv2.cvtColor(cv2.resize(rows, _CELLS, interpolation=cv2.INTER_AREA), cv2.COLOR_RGB2GRAY).astype(np.float32)
    return cells - cells.mean()


def has_moved(now: np.ndarray, before: np.ndarray) -> bool:
    """Whether images of these brightnesses differ by more than noise and exposure, which is a gain and an offset."""
    square = float(np.vdot(before, before))
    gain = float(np.vdot(now, before)) / max(square, 1.0)
    return float(np.abs(now - gain * before).mean()) > _MOVED_LEVELS


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
        return has_moved(signature.brightness, first.brightness)


class ArrivingFrozenDepth:
    """`FrozenDepth` of frames whose poses are waited for: a row of depth tells most frames from the one before.

    Of a frame that later ones are compared with, rows are copied: a camera may use its memory again.
    """

    def __init__(self) -> None:
        self._depth: np.ndarray | None = None
        self._color = np.zeros((0, 0, 3), np.uint8)

    def check(self, frame: RgbdFrame) -> bool:
        """Whether the depth of the next frame is frozen; each that is not must be given to `keep`."""
        if not self._has_depth_of(frame):
            return False
        return has_moved(_brightness(frame.color[::_COLOR_ROW_STEP]), _brightness(self._color))

    def keep(self, frame: RgbdFrame) -> None:
        """Has the next frames compared with this one, if its depth is new; takes longer than `check`."""
        if not self._has_depth_of(frame):
            self._depth = frame.depth[::_DEPTH_ROW_STEP].copy()
            self._color = frame.color[::_COLOR_ROW_STEP].copy()

    def _has_depth_of(self, frame: RgbdFrame) -> bool:
        """Whether there is depth, and the same as in the frame kept."""
        rows, kept = frame.depth[::_DEPTH_ROW_STEP], self._depth
        middle = len(rows) // 2
        # An image that is the same has the same bits.
        if kept is None or rows[middle].tobytes() != kept[middle].tobytes():
            return False
        return np.array_equal(rows, kept, equal_nan=True) and bool(rows.any())


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
