"""Image streams in files: one image per file, with confidence maps beside depth where a format has them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from spslam.datasets.images import Size, read_color, read_confidence, read_depth, usual_size
from spslam.datasets.recording import ImageStream
from spslam.errors import DatasetError


@dataclass(frozen=True)
class ColorFiles(ImageStream):
    """Color images.

    Attributes:
        paths: in order of time.
        seconds: float64 [N], s.
        size: (width, height) that each must have.
    """

    paths: Sequence[Path]
    seconds: np.ndarray
    size: Size

    def __len__(self) -> int:
        return len(self.paths)

    def times(self) -> np.ndarray:
        return self.seconds.copy()

    def read(self, number: int) -> np.ndarray:
        return read_color(self.paths[number], self.size)

    def describe(self, number: int) -> str:
        return str(self.paths[number])


@dataclass(frozen=True)
class DepthFiles(ImageStream):
    """Depth images.

    Attributes:
        paths: in order of time.
        seconds: float64 [N], s.
        size: (width, height) that each must have.
        units_per_meter: see `spslam.datasets.images.read_depth`.
        invalid: see `spslam.datasets.images.read_depth`.
        confidence: 8-bit images of the same size, one per depth image; a missing file is taken for full confidence.
        min_confidence: depth of lower confidence comes as 0.
    """

    paths: Sequence[Path]
    seconds: np.ndarray
    size: Size
    units_per_meter: float | None = None
    invalid: Sequence[int] = ()
    confidence: Sequence[Path | None] | None = None
    min_confidence: int = 0

    def __len__(self) -> int:
        return len(self.paths)

    def times(self) -> np.ndarray:
        return self.seconds.copy()

    def read(self, number: int) -> np.ndarray:
        depth = read_depth(self.paths[number], self.units_per_meter, self.invalid, self.size)
        path = self.confidence[number] if self.confidence is not None and self.min_confidence > 0 else None
        if path is not None:
            depth[read_confidence(path, self.size) < self.min_confidence] = 0
        return depth

    def describe(self, number: int) -> str:
        return str(self.paths[number])


def usual_depth_size(paths: Sequence[Path]) -> tuple[Size | None, dict[Path, str]]:
    """As `usual_size` of depth images; None where none can be read."""
    try:
        return usual_size(paths, lambda path: read_depth(path, 1.0))
    except DatasetError:
        return None, {}


def first_depth_size(paths: Sequence[Path]) -> Size | None:
    """The size (width, height) of the first depth image that can be read; None where none can."""
    for path in paths:
        try:
            height, width = read_depth(path, 1.0).shape
        except DatasetError:
            continue
        return width, height
    return None
