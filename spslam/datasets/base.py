"""What a dataset is: RGB-D frames by number, their times and, where known, their ground-truth poses."""

from __future__ import annotations

import operator
from abc import ABC, abstractmethod
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np

from spslam.camera import Camera
from spslam.datasets.clock import AT_ONCE, CaptureOffsets
from spslam.datasets.findings import Finding
from spslam.datasets.frame_arrays import UNNUMBERED, checked_arrays, checked_offset
from spslam.errors import DatasetError

if TYPE_CHECKING:
    from spslam.datasets.solids import SolidScene

# Most frames of a sequence that one file tells of: almost five hours at 30 Hz.
MAX_FRAMES = 1 << 19


@dataclass(repr=False)
class RgbdFrame:
    """One color image with its depth image, both of the same view and size.

    `RgbdFrame.from_arrays` makes one of arrays of your own, and checks them.

    Attributes:
        index: the frame's number in the dataset it was read from, counted from 0; -1 for one that `SlamSystem` is to
            number itself.
        timestamp: s.
        color: uint8 [H, W, 3], RGB.
        depth: float32 [H, W], m along the optical axis; 0 where nothing was measured.
        pose: float64 [4, 4] T_world_camera in OpenCV axes (x right, y down, z forward), or None where unknown. It is
            the ground truth to evaluate against; the system uses no more than the first.
        offsets: when the two images were taken, where that is known better than by the time stamp.
    """

    index: int
    timestamp: float
    color: np.ndarray
    depth: np.ndarray
    pose: np.ndarray | None = None
    offsets: CaptureOffsets = AT_ONCE

    @classmethod
    def from_arrays(
        cls, color: Any, depth: Any, timestamp: float, *, depth_scale: float | None = None, color_offset: float = 0.0
    ) -> RgbdFrame:
        """A frame of arrays from any camera or program, converted and checked.

        Args:
            color: uint8 [H, W, 3], RGB. OpenCV's images are BGR: `color[..., ::-1]`, or `cv2.cvtColor`.
            depth: [H, W] along the optical axis, of the same view as `color`: floating-point meters, or whole numbers
                with `depth_scale`. 0, negative numbers, NaN and infinity stand for "not measured".
            timestamp: s, when the depth image was taken; of one clock for all frames.
            depth_scale: units of `depth` per meter, 1000 for millimeters. Required for whole numbers.
            color_offset: how much later the color image was taken, s, if both have stamps of their own that tell; what
                is the same for all frames is measured (`tracking.capture_timing`).

        Returns:
            The frame, which the system numbers when it comes; depth is a copy, color is not.

        Raises:
            TypeError: another dtype.
            ValueError: another shape, images of different sizes, depth that cannot be in meters (its median is below
                1 cm or above 100 m), or a time that is not in seconds.

        Example:
            >>> millimeters = np.full((480, 640), 1500, dtype=np.uint16)
            >>> color = np.zeros((480, 640, 3), dtype=np.uint8)
            >>> RgbdFrame.from_arrays(color, millimeters, 0.0, depth_scale=1000)
            RgbdFrame(640x480, t=0.000 s, depth in 100 % of the pixels, median 1.50 m)
        """
        color, depth, timestamp = checked_arrays(color, depth, timestamp, depth_scale)
        offsets = CaptureOffsets(color=checked_offset(color_offset)) if color_offset else AT_ONCE
        return cls(UNNUMBERED, timestamp, color, depth, offsets=offsets)

    def __repr__(self) -> str:
        known = self.depth[::8, ::8] > 0 if self.depth.ndim == 2 else np.zeros(1, dtype=bool)
        number = "" if self.index == UNNUMBERED else f"{self.index}, "
        depth = "no depth"
        if known.any():
            median = float(np.median(self.depth[::8, ::8][known]))
            depth = f"depth in {100 * known.mean():.0f} % of the pixels, median {median:.2f} m"
        size = "x".join(str(length) for length in self.color.shape[1::-1])
        return f"RgbdFrame({number}{size}, t={self.timestamp:.3f} s, {depth})"


class RgbdDataset(ABC):
    """A sequence of frames of one camera, read one at a time and from any thread.

    `dataset[i]` reads frame i (0 <= i < len) and checks it: raises IndexError outside the range and DatasetError,
    naming the file, for a frame that can't be used. Reading the same frame again gives the same values.

    Attributes:
        name: of the sequence, for messages and reports.
        camera: of all frames.
        depth_range: nearest and farthest depth (m); depth outside comes as 0.
        border_px: depth within so many pixels of the image's border comes as 0.
        left_out: bool [H, W], pixels whose depth comes as 0, such as those of a robot's own arm; None for none.
        is_registered: whether depth is meant to be registered to color; where it is known not to be, checks of the data
            do not expect it.
        is_random_access: whether each frame is read by itself, so that several processes may share the frames; frames
            of a video, or of a bag, are read best in order.
        is_seekable: whether frames far apart are read about as fast as others, though by one process.
        is_timed: whether frames are in order by the recording's own time stamps, not by names of files.
        readers: number of processes that read its frames; 0 where the thread does that asks for one.
        doubts: what opening the recording found doubtful, which a run says as well as a check of the data.
        remarks: what a check of the data says besides, as it may be meant so.
        scale_remedy: how the scale of depth is set for this kind of data.
    """

    name: str
    camera: Camera
    depth_range: tuple[float, float] = (0.0, float("inf"))
    border_px: int = 0
    left_out: np.ndarray | None = None
    is_registered: bool = True
    is_random_access: bool = False
    is_seekable: bool = False
    is_timed: bool = False
    readers: int = 0
    doubts: Sequence[Finding] = ()
    remarks: Sequence[str] = ()
    scale_remedy: str = "correct the scale of depth (units per meter)"

    @abstractmethod
    def __len__(self) -> int:
        """Number of frames F."""

    @abstractmethod
    def timestamps(self) -> np.ndarray:
        """Times of all frames, float64 [F], s, ascending. Reads no image."""

    @abstractmethod
    def poses(self) -> np.ndarray | None:
        """Ground-truth poses, float64 [F, 4, 4], NaN where unknown; None if none is known. Reads no image."""

    @abstractmethod
    def read(self, index: int) -> RgbdFrame:
        """Frame `index` as it is stored, converted to our units and axes; `dataset[i]` is what to call."""

    def read_depth(self, index: int) -> np.ndarray:
        """The depth of `read(index)`; `depth(i)` is what to call. Formats that need no color for it read none."""
        return self.read(index).depth

    @property
    def surface(self) -> SolidScene | None:
        """The exact surface of generated data, to evaluate meshes by; None where it is unknown."""
        return None

    def describe(self, index: int) -> str:
        """What an error about frame `index` should name: its files where it has any."""
        return f"{self.name}, frame {index}"

    def __getitem__(self, index: int) -> RgbdFrame:
        index = self._checked_index(index)
        frame = self.read(index)
        self._check_sizes(frame)
        self._clear(frame.depth)
        return frame

    def depth(self, index: int) -> np.ndarray:
        """The depth image of a frame alone, in less time than the frame takes.

        Args:
            index: of the frame.

        Returns:
            float32 [H, W], m, `dataset[index].depth`.

        Raises:
            IndexError: outside the range.
            DatasetError: the depth image can't be used; of the color image nothing is said.
        """
        index = self._checked_index(index)
        depth = self.read_depth(index)
        self._check_size(index, depth.shape[:2])
        self._clear(depth)
        return depth

    def __iter__(self) -> Iterator[RgbdFrame]:
        return (self[index] for index in range(len(self)))

    def _checked_index(self, index: int) -> int:
        index = operator.index(index)
        if not 0 <= index < len(self):
            raise IndexError(f"{self.name}: frame must be in 0..{len(self) - 1}, got {index}")
        return index

    def _clear(self, depth: np.ndarray) -> None:
        _clear_depth_outside(depth, *self.depth_range)
        clear_border(depth, self.border_px)
        clear_left_out(depth, self.left_out)

    def _check_sizes(self, frame: RgbdFrame) -> None:
        color, depth = frame.color.shape[:2], frame.depth.shape[:2]
        if color != depth:
            raise DatasetError(
                f"{self.describe(frame.index)}: depth must be as large as color, "
                f"got depth {_size(depth)} and color {_size(color)}"
            )
        self._check_size(frame.index, color)

    def _check_size(self, index: int, shape: tuple[int, ...]) -> None:
        expected = (self.camera.height, self.camera.width)
        if shape != expected:
            raise DatasetError(
                f"{self.describe(index)}: images must be as large as the sequence's first, "
                f"{_size(expected)}, got {_size(shape)}"
            )


class Subset(RgbdDataset):
    """Every `step`-th frame of a dataset from `start` up to but without `stop`, numbered anew from 0.

    Args:
        dataset: what to take frames from.
        start: first frame. The bounds are taken as in a Python slice: beyond the end they are cut, negative ones count
            from the end.
        stop: first frame that is left out; None for the end.
        step: distance of the frames.

    Raises:
        ValueError: `step` is below 1.
        DatasetError: no frame is left.
    """

    def __init__(self, dataset: RgbdDataset, start: int = 0, stop: int | None = None, step: int = 1) -> None:
        if step < 1:
            raise ValueError(f"Subset: step must be at least 1, got {step}")
        self._dataset = dataset
        self._indices = range(*slice(start, stop, step).indices(len(dataset)))
        if not self._indices:
            wanted = f"{start}:{'' if stop is None else stop}:{step}"
            raise DatasetError(
                f"{dataset.name}: frames must select at least one of 0..{len(dataset) - 1}, got {wanted}"
            )
        self.name = dataset.name
        self.camera = dataset.camera
        self.depth_range = dataset.depth_range
        self.border_px, self.left_out = dataset.border_px, dataset.left_out
        self.is_registered = dataset.is_registered
        self.is_random_access, self.is_seekable = dataset.is_random_access, dataset.is_seekable
        self.is_timed = dataset.is_timed
        self.doubts, self.remarks, self.scale_remedy = dataset.doubts, dataset.remarks, dataset.scale_remedy

    def __len__(self) -> int:
        return len(self._indices)

    def timestamps(self) -> np.ndarray:
        return self._dataset.timestamps()[self._slice()]

    def poses(self) -> np.ndarray | None:
        poses = self._dataset.poses()
        return None if poses is None else poses[self._slice()]

    def read(self, index: int) -> RgbdFrame:
        return replace(self._dataset.read(self._indices[index]), index=index)

    def read_depth(self, index: int) -> np.ndarray:
        return self._dataset.read_depth(self._indices[index])

    @property
    def surface(self) -> SolidScene | None:
        return self._dataset.surface

    def describe(self, index: int) -> str:
        return self._dataset.describe(self._indices[index])

    def _slice(self) -> slice:
        return slice(self._indices.start, self._indices.stop, self._indices.step)


def _clear_depth_outside(depth: np.ndarray, nearest: float, farthest: float) -> None:
    # OpenCV's threshold is some ten times faster than a NumPy mask, and a frame passes here every few ms.
    if nearest > 0:
        cv2.threshold(depth, np.nextafter(np.float32(nearest), np.float32(0)), 0, cv2.THRESH_TOZERO, dst=depth)
    if farthest < float("inf"):
        cv2.threshold(depth, farthest, 0, cv2.THRESH_TOZERO_INV, dst=depth)


def clear_border(depth: np.ndarray, width: int) -> None:
    """Sets depth within `width` pixels of the border to 0, unknown, in place."""
    if width > 0:
        depth[:width] = depth[-width:] = 0
        depth[:, :width] = depth[:, -width:] = 0


def clear_left_out(depth: np.ndarray, left_out: np.ndarray | None) -> None:
    """Sets depth [H, W] of pixels bool [H, W] to 0, unknown, in place; None for none."""
    if left_out is not None:
        np.copyto(depth, 0, where=left_out)


def _size(shape: tuple[int, ...]) -> str:
    return f"{shape[1]}x{shape[0]}"
