"""Detects a frozen depth stream: the same depth image again, with another color image."""

from __future__ import annotations

import zlib
from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

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


class Signature(Protocol):
    """What is compared of a frame.

    Attributes:
        depth: checksum of the depth image; 0 without depth.
        brightness: float32 [12, 16], mean brightness of the cells of a grid, less the image's mean.
    """

    @property
    def depth(self) -> int: ...

    @property
    def brightness(self) -> np.ndarray: ...


@dataclass(frozen=True)
class FrameSignature:
    """A `Signature` that is kept, or sent to another process, without its frame."""

    depth: int
    brightness: np.ndarray

    @classmethod
    def of(cls, frame: RgbdFrame) -> FrameSignature:
        """The signature of a frame."""
        return cls(_checksum(frame.depth), _brightness(frame.color[::_COLOR_ROW_STEP]))


class ArrivingSignature:
    """A `Signature` of a frame whose pose is waited for: brightness is looked at where depth does not tell.

    It keeps rows of the color image, not the frame, whose memory a camera may use again.
    """

    def __init__(self, frame: RgbdFrame) -> None:
        self.depth, self._rows = _checksum(frame.depth), frame.color[::_COLOR_ROW_STEP].copy()

    @cached_property
    def brightness(self) -> np.ndarray:
        return _brightness(self._rows)


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

    def __init__(self, first: Signature | None = None) -> None:
        self._first = first

    def check(self, signature: Signature) -> bool:
        """Whether the depth of the next frame is frozen. A camera that stands still before an exact sensor is not."""
        first = self._first
        if first is None or not signature.depth or signature.depth != first.depth:
            self._first = signature
            return False
        return has_moved(signature.brightness, first.brightness)


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
