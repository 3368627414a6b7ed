"""Small copies of frames spread over a stretch of a recording: what the checks look at."""

from __future__ import annotations

import zlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from spslam.camera import Camera
from spslam.datasets.base import RgbdDataset, RgbdFrame, clear_left_out
from spslam.datasets.frozen_depth import FrameSignature
from spslam.datasets.prefetch import prefetch
from spslam.errors import DatasetError

# Images are reduced to this width: features are tracked to a fifth of a pixel, which is enough there.
MAX_WIDTH_PX = 320
# Between views: hand-held, an image then moves by 2 to 8 % of its width.
SECONDS_BETWEEN_VIEWS = 1 / 15
# Where time stamps say nothing.
_USUAL_RATE_HZ = 30.0
# No camera is faster; shorter steps come from other units, or from damage.
_LEAST_STEP_S = 1e-6
_READING_THREADS = 2


@dataclass(frozen=True)
class View:
    """A frame reduced in size.

    Attributes:
        index: of the frame in its dataset.
        timestamp: s.
        gray: uint8 [h, w], at most 320 px wide.
        depth: float32 [h, w], m, as stored: not limited to the run's range; 0 unknown.
        signature: see `FrameSignature`.
        color_checksum: of the gray image.
        range_share: share of the pixels with depth whose depth is in the dataset's range.
        known_share: share of the pixels that have any depth.
    """

    index: int
    timestamp: float
    gray: np.ndarray
    depth: np.ndarray
    signature: FrameSignature
    color_checksum: int
    range_share: float
    known_share: float

    @classmethod
    def of(cls, frame: RgbdFrame, depth_range: tuple[float, float] = (0.0, float("inf"))) -> View:
        """The view of a frame.

        Args:
            frame: both images of one size, depth as stored.
            depth_range: of its dataset.
        """
        width, height = reduced_size(frame.color.shape[1], frame.color.shape[0])
        small = cv2.resize(frame.color, (width, height), interpolation=cv2.INTER_AREA)
        gray = cv2.cvtColor(small, cv2.COLOR_RGB2GRAY)
        depth = cv2.resize(frame.depth, (width, height), interpolation=cv2.INTER_NEAREST)
        depth = np.where(np.isfinite(depth) & (depth > 0), depth, np.float32(0))
        known = int(np.count_nonzero(depth))
        inside = int(np.count_nonzero((depth >= max(depth_range[0], 1e-9)) & (depth <= depth_range[1])))
        return cls(
            frame.index,
            frame.timestamp,
            gray,
            depth,
            FrameSignature.of(frame),
            zlib.crc32(gray.tobytes()),
            inside / max(known, 1),
            known / depth.size,
        )


@dataclass(frozen=True)
class Stretch:
    """Views in order, and the camera of their size.

    Attributes:
        camera: as the recording says, for the size of the views.
        views: in the order of the recording.
        poses: float64 [len(views), 4, 4] T_world_camera of the views, NaN where unknown; None without any.
    """

    camera: Camera
    views: Sequence[View]
    poses: np.ndarray | None

    def known_depth(self) -> np.ndarray:
        """All depths of all views, float32 [N], m."""
        return np.concatenate([view.depth[view.depth > 0] for view in self.views] or [np.zeros(0, np.float32)])


def reduced_size(width: int, height: int) -> tuple[int, int]:
    """Width and height of a view of an image."""
    scale = min(1.0, MAX_WIDTH_PX / width)
    return max(round(width * scale), 1), max(round(height * scale), 1)


def view_stride(timestamps: np.ndarray) -> int:
    """Frames from one view to the next.

    Args:
        timestamps: of all frames, s; of any kind, even all alike.
    """
    steps = np.diff(timestamps)
    steps = steps[np.isfinite(steps) & (steps > 0)]
    step_s = max(float(np.median(steps)), _LEAST_STEP_S) if len(steps) else 1 / _USUAL_RATE_HZ
    return max(1, round(SECONDS_BETWEEN_VIEWS / step_s))


def read_views(dataset: RgbdDataset, indices: Sequence[int]) -> list[View]:
    """The views of some frames; those that can't be read are left out.

    Args:
        dataset: to read from.
        indices: of the frames, ascending.
    """
    with prefetch(_Views(dataset, indices), _READING_THREADS, 2 * _READING_THREADS) as views:
        return [view for view in _each(views) if isinstance(view, View)]


def stretch_of(dataset: RgbdDataset, views: Sequence[View]) -> Stretch:
    """The views with the camera of their size and the dataset's poses."""
    poses = dataset.poses()
    camera = dataset.camera.resized(*reduced_size(dataset.camera.width, dataset.camera.height))
    return Stretch(camera, views, None if poses is None else poses[[view.index for view in views]])


class _Views:
    """The views of some frames of a dataset, read one at a time."""

    def __init__(self, dataset: RgbdDataset, indices: Sequence[int]) -> None:
        self._dataset, self._indices = dataset, indices

    def __len__(self) -> int:
        return len(self._indices)

    def __getitem__(self, number: int) -> View:
        index = int(self._indices[number])
        frame = self._dataset.read(index)
        shape = (self._dataset.camera.height, self._dataset.camera.width)
        if frame.color.shape[:2] != shape or frame.depth.shape != shape:
            raise DatasetError(f"{self._dataset.describe(index)}: images of another size")
        clear_left_out(frame.depth, self._dataset.left_out)
        return View.of(frame, self._dataset.depth_range)


def _each(views: Iterator[View | DatasetError]) -> Iterator[View | DatasetError]:
    yield from views
