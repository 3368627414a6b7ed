"""Datasets that are a list of image files: what the formats have in common."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from spslam.camera import Camera
from spslam.datasets.base import RgbdDataset, RgbdFrame
from spslam.datasets.clock import AT_ONCE, CaptureOffsets
from spslam.datasets.findings import Finding
from spslam.datasets.images import read_color, read_depth, resized_color
from spslam.datasets.lens import Rectification
from spslam.datasets.registration import ColorToDepth
from spslam.errors import DatasetError

_MAX_NUMBER = 2**63 - 1


@dataclass(frozen=True)
class FramePaths:
    """One frame's files and time.

    Attributes:
        color: image file.
        depth: image file.
        timestamp: s.
        fault: why the frame can't be used, if that is known beforehand.
        offsets: when the images were taken; see `RgbdFrame`.
    """

    color: Path
    depth: Path
    timestamp: float
    fault: str | None = None
    offsets: CaptureOffsets = AT_ONCE


@dataclass
class FileDataset(RgbdDataset):
    """Frames in image files.

    Attributes:
        frames: the files in order of time.
        gt_poses: float64 [F, 4, 4], NaN where unknown, or None.
        units_per_meter: see `spslam.datasets.images.read_depth`.
        invalid_depth: see `spslam.datasets.images.read_depth`.
        undistortion: of the color lens, applied to both images: depth that is registered to color lies in its pixels.
        resize_color: bring each color image, of whatever size, to its depth image's size.
        registration: brings the color image, which another camera took, to the depth camera's view.
        is_registered: see `RgbdDataset`.
        is_random_access: see `RgbdDataset`.
        doubts: see `RgbdDataset`.
    """

    name: str
    camera: Camera
    frames: Sequence[FramePaths]
    gt_poses: np.ndarray | None
    units_per_meter: float | None
    invalid_depth: Sequence[int] = ()
    undistortion: Rectification | None = None
    resize_color: bool = False
    registration: ColorToDepth | None = None
    depth_range: tuple[float, float] = field(default=(0.0, float("inf")))
    border_px: int = 0
    is_registered: bool = True
    is_random_access: bool = True
    doubts: Sequence[Finding] = ()

    def __post_init__(self) -> None:
        if self.gt_poses is not None and not np.isfinite(self.gt_poses).any():
            self.gt_poses = None

    def __len__(self) -> int:
        return len(self.frames)

    def timestamps(self) -> np.ndarray:
        return np.array([frame.timestamp for frame in self.frames], dtype=np.float64)

    def poses(self) -> np.ndarray | None:
        return None if self.gt_poses is None else self.gt_poses.copy()

    def read(self, index: int) -> RgbdFrame:
        paths, size = self._usable(index), (self.camera.width, self.camera.height)
        color = read_color(paths.color, None if self.resize_color else size)
        depth = read_depth(paths.depth, self.units_per_meter, self.invalid_depth, size)
        if self.undistortion is not None:
            color, depth = self.undistortion.color(color), self.undistortion.depth(depth)
        if self.resize_color:
            color = resized_color(color, depth.shape[1], depth.shape[0])
        if self.registration is not None:
            color, depth = self.registration(color, depth, in_place=True)
        return RgbdFrame(index, paths.timestamp, color, depth, self._pose(index), paths.offsets)

    def read_depth(self, index: int) -> np.ndarray:
        size = self.camera.width, self.camera.height
        depth = read_depth(self._usable(index).depth, self.units_per_meter, self.invalid_depth, size)
        if self.undistortion is not None:
            depth = self.undistortion.depth(depth)
        return depth if self.registration is None else self.registration.depth(depth, in_place=True)

    def describe(self, index: int) -> str:
        return f"{self.frames[index].depth} (color: {self.frames[index].color.name})"

    def _usable(self, index: int) -> FramePaths:
        paths = self.frames[index]
        if paths.fault is not None:
            raise DatasetError(paths.fault)
        return paths

    def _pose(self, index: int) -> np.ndarray | None:
        if self.gt_poses is None or not np.isfinite(self.gt_poses[index]).all():
            return None
        return self.gt_poses[index].copy()


def require_folder(path: Path) -> Path:
    """The path itself if it is a folder; raises DatasetError otherwise."""
    if not path.exists():
        raise DatasetError(f"{path}: no such folder")
    if not path.is_dir():
        raise DatasetError(f"{path}: must be a folder, got a file")
    return path


def find_numbered(folder: Path, pattern: str) -> dict[int, Path]:
    """The files of a folder by number, ascending.

    Args:
        folder: a missing one has none.
        pattern: regular expression that a whole name must match; its first group is the number.

    Raises:
        DatasetError: two files have the same number, or one has a number of over 63 bits.
    """
    expression = re.compile(pattern)
    found: dict[int, Path] = {}
    for path in sorted(folder.iterdir()) if folder.is_dir() else ():
        match = expression.fullmatch(path.name)
        if match is None:
            continue
        number = int(match.group(1))
        if number > _MAX_NUMBER:
            raise DatasetError(f"{path}: the number in the name must be at most {_MAX_NUMBER}")
        if number in found:
            raise DatasetError(f"{path}: must be the only file of frame {number}, got {found[number].name} as well")
        found[number] = path
    return dict(sorted(found.items()))


def pair_numbered(
    colors: Mapping[int, Path], depths: Mapping[int, Path], frames_per_second: float
) -> dict[int, FramePaths]:
    """Frames of the numbers that have a color or a depth image; one without the other is a frame with a fault.

    Args:
        colors: files by number.
        depths: files by number.
        frames_per_second: times count from the first number at this rate, so that a gap in the numbers is a gap in
            time.

    Returns:
        Frames by number, ascending.
    """
    frames = {}
    numbers = sorted({*colors, *depths})
    for number in numbers:
        frames[number] = paired(colors.get(number), depths.get(number), (number - numbers[0]) / frames_per_second)
    return frames


def paired(color: Path | None, depth: Path | None, timestamp: float) -> FramePaths:
    """The frame of a color and a depth image, one of which may be missing: then it is one with a fault."""
    fault = None
    if color is None or depth is None:
        kind, present = ("color", depth) if color is None else ("depth", color)
        fault = f"{present}: the {kind} image of this frame is missing"
    return FramePaths(color or depth, depth or color, timestamp, fault)  # type: ignore[arg-type]
