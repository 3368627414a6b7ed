"""Recordings of two image streams: color and depth, each with its lens, size, place and times.

Formats give the streams, the pairs and the calibration. What is common to all of them is here: lens distortion is
undone (`spslam.datasets.lens`), one image is brought to the other's view (`spslam.datasets.registration`), and errors
name the image.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

import cv2
import numpy as np

from spslam.camera import Camera
from spslam.datasets.base import RgbdDataset, RgbdFrame
from spslam.datasets.clock import capture_offsets, capture_times
from spslam.datasets.images import resized_color
from spslam.datasets.lens import Lens, Rectification
from spslam.datasets.registration import ColorToDepth, DepthToColor, is_same_view
from spslam.errors import DatasetError, brief

View = Literal["depth", "color"]


class ImageStream(ABC):
    """The images of one camera by number, read from any thread."""

    @abstractmethod
    def __len__(self) -> int:
        """Number of images N."""

    @abstractmethod
    def times(self) -> np.ndarray:
        """Times of all images, float64 [N], s, ascending. Reads no image."""

    @abstractmethod
    def read(self, number: int) -> np.ndarray:
        """Image `number`: color as uint8 [H, W, 3] RGB, or depth as float32 [H, W] in meters with 0 for unknown.

        Raises:
            DatasetError: it can't be read; the message begins with `describe(number)`.
        """

    @abstractmethod
    def describe(self, number: int) -> str:
        """What an error about image `number` should name: its file, and its place in there."""


@dataclass(frozen=True)
class TimedImages(ImageStream):
    """Some images of a stream, at the times of the frames that they are of.

    Attributes:
        stream: has the images.
        numbers: int64 [N], theirs in the stream.
        seconds: float64 [N], ascending.
    """

    stream: ImageStream
    numbers: np.ndarray
    seconds: np.ndarray

    def __len__(self) -> int:
        return len(self.numbers)

    def times(self) -> np.ndarray:
        return self.seconds.copy()

    def describe(self, number: int) -> str:
        return self.stream.describe(int(self.numbers[number]))

    def read(self, number: int) -> np.ndarray:
        return self.stream.read(int(self.numbers[number]))


@dataclass(frozen=True)
class Calibration:
    """The lenses of a recording and where they are.

    Attributes:
        color: of the color images.
        depth: of the depth images.
        color_from_depth: float64 [4, 4], maps points of the depth camera to points of the color camera, m.
    """

    color: Lens
    depth: Lens
    color_from_depth: np.ndarray = field(default_factory=lambda: np.eye(4))

    @classmethod
    def of_one_view(cls, color: Lens, depth_size: tuple[int, int]) -> Calibration:
        """Of depth that is registered to color already, in a size (width, height) of its own."""
        return cls(color, Lens(color.camera.resized(*depth_size), color.model, color.coefficients))


class FrameGeometry:
    """Turns a color and a depth image as they were taken into those of one pinhole camera.

    Args:
        calibration: of the images given.
        view: whose view the images are brought to. If both see the same, the color image is brought to depth's size,
            or the depth image to color's.

    Raises:
        DatasetError: a lens whose distortion leaves less than half of its image.

    Attributes:
        camera: of the images returned.
        color_from_camera: float64 [4, 4], points of `camera` to points of the color camera.
    """

    def __init__(self, calibration: Calibration, view: View = "depth") -> None:
        color, depth = calibration.color, calibration.depth
        self._color_size = color.camera.width, color.camera.height
        self._depth_size = depth.camera.width, depth.camera.height
        self._color_lens, self._depth_lens = _rectification(color, "color"), _rectification(depth, "depth")
        unseen = self._color_lens.unseen if self._color_lens is not None and self._color_lens.unseen.any() else None
        self._register: ColorToDepth | DepthToColor | None = None
        self._resizes = view == "depth" and is_same_view(color.camera, depth.camera, calibration.color_from_depth)
        if not self._resizes and (color.camera != depth.camera or calibration.color_from_depth.tolist() != _IDENTITY):
            place = calibration.color_from_depth
            if view == "depth":
                self._register = ColorToDepth(color.camera, depth.camera, place, unseen)
            else:
                self._register = DepthToColor(color.camera, depth.camera, place)
        self.camera: Camera = depth.camera if view == "depth" else color.camera
        # Pixels that the color image has nothing for: their depth has no color.
        self._unseen: np.ndarray | None = None
        if unseen is not None and not isinstance(self._register, ColorToDepth):
            size = self.camera.width, self.camera.height
            self._unseen = cv2.resize(unseen.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST).astype(bool)
        self.color_from_camera = calibration.color_from_depth if view == "depth" else np.eye(4)

    def __call__(self, color: np.ndarray, depth: np.ndarray, name: str) -> tuple[np.ndarray, np.ndarray]:
        """One pair of images in the view of `camera`.

        Args:
            color: uint8 [Hc, Wc, 3], RGB.
            depth: float32 [Hd, Wd], m, 0 where nothing was measured.
            name: what an error begins with.

        Returns:
            uint8 [H, W, 3], and float32 [H, W].

        Raises:
            DatasetError: an image of another size than its camera.
        """
        _check_size("color", color, self._color_size, name)
        if self._color_lens is not None:
            color = self._color_lens.color(color)
        depth = self._without_distortion(depth, name)
        if self._register is not None:
            color, depth = self._register(color, depth)
        elif self._resizes:
            color = resized_color(color, self.camera.width, self.camera.height)
        return color, self._without_unseen(depth)

    def depth(self, depth: np.ndarray, name: str) -> np.ndarray:
        """The depth image, float32 [H, W], as a call returns it, without the color image; arguments as there."""
        depth = self._without_distortion(depth, name)
        return self._without_unseen(depth if self._register is None else self._register.depth(depth))

    def _without_distortion(self, depth: np.ndarray, name: str) -> np.ndarray:
        _check_size("depth", depth, self._depth_size, name)
        return depth if self._depth_lens is None else self._depth_lens.depth(depth)

    def _without_unseen(self, depth: np.ndarray) -> np.ndarray:
        return depth if self._unseen is None else np.where(self._unseen, np.float32(0), depth)


def _check_size(kind: str, image: np.ndarray, size: tuple[int, int], name: str) -> None:
    if image.shape[1::-1] != size:
        raise DatasetError(
            f"{name}: the {kind} image must be as large as its camera, {size[0]}x{size[1]}, "
            f"got {image.shape[1]}x{image.shape[0]}"
        )


_IDENTITY = np.eye(4).tolist()
# Less of an image is left by no lens that images are taken with, but by coefficients of another model or order.
_LEAST_SEEN = 0.5


def _rectification(lens: Lens, kind: str) -> Rectification | None:
    if not lens.is_distorted:
        return None
    rectification = Rectification.of(lens)
    seen = 1 - float(rectification.unseen.mean())
    if seen < _LEAST_SEEN:
        raise DatasetError(
            f"the distortion of the {kind} lens must leave most of the image, but leaves {seen:.0%}: "
            f"{lens.model} {brief(list(lens.coefficients))} is the wrong model, or in the wrong order"
        )
    return rectification


class Recording(RgbdDataset):
    """Frames of two image streams, registered to each other.

    A frame has the time stamp of its depth image, by which the camera is tracked; when its images were taken is read
    from all stamps of each stream (`spslam.datasets.clock`).

    Args:
        name: of the sequence.
        color: color images.
        depth: depth images.
        pairs: int64 [F, 2], numbers of the color and the depth image of each frame, in order of time.
        calibration: of both.
        poses: float64 [F, 4, 4] `T_world_camera` of the color camera, NaN where unknown, or None.
        view: the camera to whose view the frames are registered.
        faults: frames that can't be used, by number, and why.

    Raises:
        DatasetError: as `FrameGeometry`.
    """

    def __init__(
        self,
        name: str,
        color: ImageStream,
        depth: ImageStream,
        pairs: np.ndarray,
        calibration: Calibration,
        poses: np.ndarray | None = None,
        *,
        view: View = "depth",
        faults: Mapping[int, str] | None = None,
    ) -> None:
        self.name = name
        self._color, self._depth, self._pairs = color, depth, pairs
        try:
            self._geometry = FrameGeometry(calibration, view)
        except DatasetError as error:
            raise DatasetError(f"{name}: {error}") from None
        self.camera = self._geometry.camera
        color_times, depth_times = color.times(), depth.times()
        self._times = depth_times[pairs[:, 1]]
        taken = (capture_times(times)[pairs[:, i]] for i, times in enumerate((color_times, depth_times)))
        self._offsets = capture_offsets(self._times, *taken)
        has_poses = poses is not None and np.isfinite(poses).any()
        self._poses = poses @ self._geometry.color_from_camera if has_poses else None  # type: ignore[operator]
        self._faults = dict(faults or {})

    def __len__(self) -> int:
        return len(self._pairs)

    def timestamps(self) -> np.ndarray:
        return self._times.copy()

    def poses(self) -> np.ndarray | None:
        return None if self._poses is None else self._poses.copy()

    def read(self, index: int) -> RgbdFrame:
        color, depth = self._usable(index)
        images = self._geometry(self._color.read(color), self._depth.read(depth), self.describe(index))
        pose = None
        if self._poses is not None and np.isfinite(self._poses[index]).all():
            pose = self._poses[index].copy()
        return RgbdFrame(index, float(self._times[index]), *images, pose, self._offsets[index])

    def read_depth(self, index: int) -> np.ndarray:
        _, depth = self._usable(index)
        return self._geometry.depth(self._depth.read(depth), self.describe(index))

    def _usable(self, index: int) -> tuple[int, int]:
        """Numbers of a frame's color and depth image."""
        if index in self._faults:
            raise DatasetError(self._faults[index])
        color, depth = (int(number) for number in self._pairs[index])
        return color, depth

    def describe(self, index: int) -> str:
        color, depth = (int(number) for number in self._pairs[index])
        return f"{self._depth.describe(depth)} (color: {self._color.describe(color)})"
