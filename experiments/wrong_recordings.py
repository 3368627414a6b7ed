"""Recordings that are wrong in one way each: intrinsics, scale, axes, pairing, streams, order, lens, encoding."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import cv2
import numpy as np

from spslam.camera import Camera
from spslam.datasets.base import RgbdDataset, RgbdFrame

Reader = Callable[[int], RgbdFrame]
Order = Callable[[int], np.ndarray]


@dataclass(frozen=True)
class Fault:
    """One way to be wrong.

    Attributes:
        camera: what the recording claims its camera is, from the true one.
        frame: frame i as the recording has it, from the reader of true frames, i, and the number of frames.
        order: which true frame comes when, from the number of frames; None keeps the order.
        poses: the poses that the recording claims, from the true ones.
        times: the times that the recording claims, from the true ones.
        world: the true poses as they are in the wrong recording's own world, such as a mirrored one.
    """

    camera: Callable[[Camera], Camera] = lambda camera: camera
    frame: Callable[[Reader, int, int], RgbdFrame] = lambda read, i, count: read(i)
    order: Order | None = None
    poses: Callable[[np.ndarray], np.ndarray] = lambda poses: poses
    times: Callable[[np.ndarray], np.ndarray] = lambda times: times


class WrongRecording(RgbdDataset):
    """A dataset with a fault.

    Args:
        dataset: what is true.
        fault: what is made wrong.
        with_poses: whether the recording comes with poses.
    """

    def __init__(self, dataset: RgbdDataset, fault: Fault, with_poses: bool = True) -> None:
        self._dataset, self._fault, self._with_poses = dataset, fault, with_poses
        count = len(dataset)
        self._order = np.arange(count) if fault.order is None else fault.order(count)
        self.name = dataset.name
        self.camera = fault.camera(dataset.camera)
        self.depth_range, self.border_px = dataset.depth_range, dataset.border_px

    def __len__(self) -> int:
        return len(self._order)

    def timestamps(self) -> np.ndarray:
        return self._fault.times(self._dataset.timestamps()[: len(self)])

    def poses(self) -> np.ndarray | None:
        true = self.true_poses()
        return self._fault.poses(true) if self._with_poses else None

    def true_poses(self) -> np.ndarray:
        """Of the frames in the order in which they come."""
        poses = self._dataset.poses()
        if poses is None:
            raise ValueError("WrongRecording: dataset must have poses, got none")
        return poses[self._order]

    def read(self, index: int) -> RgbdFrame:
        frame = self._fault.frame(self._read_true, index, len(self))
        return replace(frame, index=index, timestamp=float(self.timestamps()[index]), pose=None)

    def _read_true(self, index: int) -> RgbdFrame:
        return self._dataset.read(int(self._order[index]))


def _camera(**factors: float) -> Fault:
    """Intrinsics multiplied by factors."""
    return Fault(camera=lambda c: replace(c, **{name: getattr(c, name) * by for name, by in factors.items()}))


def _offset(**shares: float) -> Fault:
    """Principal point off by shares of the focal length."""
    return Fault(camera=lambda c: replace(c, **{name: getattr(c, name) + by * c.fx for name, by in shares.items()}))


def _depth(change: Callable[[np.ndarray], np.ndarray]) -> Fault:
    def frame(read: Reader, i: int, count: int) -> RgbdFrame:
        true = read(i)
        return replace(true, depth=np.ascontiguousarray(change(true.depth), dtype=np.float32))

    return Fault(frame=frame)


def _color(change: Callable[[np.ndarray], np.ndarray]) -> Fault:
    def frame(read: Reader, i: int, count: int) -> RgbdFrame:
        true = read(i)
        return replace(true, color=np.ascontiguousarray(change(true.color)))

    return Fault(frame=frame)


def _both(change: Callable[[np.ndarray], np.ndarray]) -> Fault:
    def frame(read: Reader, i: int, count: int) -> RgbdFrame:
        true = read(i)
        color, depth = (np.ascontiguousarray(change(image)) for image in (true.color, true.depth))
        return replace(true, color=color, depth=depth)

    return Fault(frame=frame)


def _color_from(source: Callable[[int, int], int]) -> Fault:
    def frame(read: Reader, i: int, count: int) -> RgbdFrame:
        return replace(read(i), color=read(source(i, count)).color)

    return Fault(frame=frame)


def _depth_from(source: Callable[[int, int], int]) -> Fault:
    def frame(read: Reader, i: int, count: int) -> RgbdFrame:
        return replace(read(i), depth=read(source(i, count)).depth)

    return Fault(frame=frame)


def _all_from(source: Callable[[int, int], int]) -> Fault:
    return Fault(frame=lambda read, i, count: read(source(i, count)))


def _clip(i: int, count: int) -> int:
    return min(max(i, 0), count - 1)


def _resampled(image: np.ndarray, matrix: np.ndarray) -> np.ndarray:
    height, width = image.shape[:2]
    return cv2.warpAffine(image, matrix, (width, height), flags=cv2.INTER_NEAREST | cv2.WARP_INVERSE_MAP)


def _shifted(x: float, y: float = 0.0, scale: float = 1.0, degrees: float = 0.0) -> Callable[[np.ndarray], np.ndarray]:
    """Shifted by shares of the width, scaled and turned about the center."""

    def change(image: np.ndarray) -> np.ndarray:
        height, width = image.shape[:2]
        matrix = cv2.getRotationMatrix2D(((width - 1) / 2, (height - 1) / 2), degrees, scale)
        matrix[:, 2] += x * width, y * width
        return _resampled(image, matrix)

    return change


def _distorted(k1: float) -> Fault:
    """Both images through a lens with radial distortion k1, as a recording that was not undistorted has them."""

    def frame(read: Reader, i: int, count: int) -> RgbdFrame:
        true = read(i)
        height, width = true.depth.shape
        focal = 0.9 * width
        v, u = np.mgrid[:height, :width].astype(np.float32)
        x, y = (u - (width - 1) / 2) / focal, (v - (height - 1) / 2) / focal
        undistorted_x, undistorted_y = x, y
        for _ in range(8):
            factor = 1 + k1 * (undistorted_x**2 + undistorted_y**2)
            undistorted_x, undistorted_y = x / factor, y / factor
        map_x = (undistorted_x * focal + (width - 1) / 2).astype(np.float32)
        map_y = (undistorted_y * focal + (height - 1) / 2).astype(np.float32)
        color = cv2.remap(true.color, map_x, map_y, cv2.INTER_LINEAR)
        depth = cv2.remap(true.depth, map_x, map_y, cv2.INTER_NEAREST)
        return replace(true, color=color, depth=depth)

    return Fault(frame=frame)


def _along_ray() -> Fault:
    """Depth as the distance from the camera's center, as renderers and some drivers give it."""

    def frame(read: Reader, i: int, count: int) -> RgbdFrame:
        true = read(i)
        height, width = true.depth.shape
        v, u = np.mgrid[:height, :width].astype(np.float32)
        focal = 0.87 * width
        length = np.sqrt(1 + ((u - (width - 1) / 2) / focal) ** 2 + ((v - (height - 1) / 2) / focal) ** 2)
        return replace(true, depth=(true.depth * length).astype(np.float32))

    return Fault(frame=frame)


def _text_order(count: int) -> np.ndarray:
    return np.array(sorted(range(count), key=str))


def _shuffled(count: int) -> np.ndarray:
    return np.random.default_rng(0).permutation(count)


def _blocks_reversed(count: int) -> np.ndarray:
    """Blocks of ten frames, each backward."""
    return np.concatenate([np.arange(start, min(start + 10, count))[::-1] for start in range(0, count, 10)])


def _flip_poses(poses: np.ndarray) -> np.ndarray:
    return poses @ np.diag([1.0, -1.0, -1.0, 1.0])


def _scaled_poses(factor: float) -> Fault:
    def poses(true: np.ndarray) -> np.ndarray:
        scaled = true.copy()
        scaled[:, :3, 3] *= factor
        return scaled

    return Fault(poses=poses)


def _swapped_bytes(depth: np.ndarray) -> np.ndarray:
    stored = np.clip(1000 * depth, 0, 65535).astype(np.uint16)
    return stored.byteswap().astype(np.float32) / 1000


def _as_disparity(depth: np.ndarray) -> np.ndarray:
    return np.where(depth > 0, 3.0 / np.maximum(depth, 0.05), 0)


def _inverted(depth: np.ndarray) -> np.ndarray:
    return np.where(depth > 0, np.maximum(depth.max() + 0.5 - depth, 0.1), 0)


def _few_bits(depth: np.ndarray) -> np.ndarray:
    return np.rint(depth / 10 * 255) * (10 / 255)


FAULTS: dict[str, Fault] = {
    "none": Fault(),
    **{f"focal length x {by:g}": _camera(fx=by, fy=by) for by in (0.5, 0.8, 0.9, 0.95, 1.05, 1.1, 1.25, 2)},
    "fx x 1.1": _camera(fx=1.1),
    "fy x 0.9": _camera(fy=0.9),
    "fx, fy of twice the size, cx, cy too": _camera(fx=2, fy=2, cx=2, cy=2),
    "intrinsics of half the size": _camera(fx=0.5, fy=0.5, cx=0.5, cy=0.5),
    "cx off by 5 % of f": _offset(cx=0.05),
    "cx off by 10 % of f": _offset(cx=-0.1),
    "cy off by 10 % of f": _offset(cy=0.1),
    "cx and cy swapped": Fault(camera=lambda c: replace(c, cx=c.cy, cy=c.cx)),
    **{f"depth x {by:g}": _depth(lambda d, by=by: d * by) for by in (0.001, 0.1, 0.2, 0.9, 1.1, 5, 6.5535, 1000)},
    "depth + 20 cm": _depth(lambda d: np.where(d > 0, d + 0.2, 0)),
    "depth along the ray": _along_ray(),
    "disparity as depth": _depth(_as_disparity),
    "depth inverted": _depth(_inverted),
    "depth of 8 bits": _depth(_few_bits),
    "depth with bytes swapped": _depth(_swapped_bytes),
    "depth of one value": _depth(lambda d: np.full_like(d, 2.0)),
    "depth mirrored": _depth(lambda d: d[:, ::-1]),
    "depth upside down": _depth(lambda d: d[::-1]),
    "color mirrored": _color(lambda c: c[:, ::-1]),
    "color upside down": _color(lambda c: c[::-1]),
    "color turned by 180 deg": _color(lambda c: c[::-1, ::-1]),
    "both mirrored": _both(lambda image: image[:, ::-1]),
    "both upside down": _both(lambda image: image[::-1]),
    "both turned by 180 deg": _both(lambda image: image[::-1, ::-1]),
    "color BGR": _color(lambda c: c[..., ::-1]),
    "color inverted": _color(lambda c: 255 - c),
    "color unregistered: 5 % to the side": _color(_shifted(0.05)),
    "color unregistered: 10 % to the side": _color(_shifted(-0.1)),
    "color unregistered: 10 % larger": _color(_shifted(0, scale=1.1)),
    "color unregistered: 25 % larger": _color(_shifted(0, scale=1.25)),
    "color unregistered: turned by 5 deg": _color(_shifted(0, degrees=5)),
    "lens distortion k1 = -0.2": _distorted(-0.2),
    "lens distortion k1 = 0.2": _distorted(0.2),
    "color 5 frames late": _color_from(lambda i, count: _clip(i - 5, count)),
    "color 15 frames early": _color_from(lambda i, count: _clip(i + 15, count)),
    "color in reverse": _color_from(lambda i, count: count - 1 - i),
    "color frozen": _color_from(lambda i, count: 0),
    "depth frozen": _depth_from(lambda i, count: 0),
    "depth every fifth frame": _depth_from(lambda i, count: i - i % 5),
    "both frozen": _all_from(lambda i, count: 0),
    "every frame five times": _all_from(lambda i, count: i // 5),
    "frames sorted as text": Fault(order=_text_order),
    "frames shuffled": Fault(order=_shuffled),
    "blocks of ten reversed": Fault(order=_blocks_reversed),
    "frames in reverse": Fault(order=lambda count: np.arange(count)[::-1]),
    "every 15th frame": Fault(order=lambda count: np.arange(0, count, 15)),
    "time stamps in reverse": Fault(times=lambda times: times[::-1].copy()),
    "time stamps all zero": Fault(times=np.zeros_like),
    "poses world-to-camera": Fault(poses=np.linalg.inv),
    "poses in OpenGL axes": Fault(poses=_flip_poses),
    "poses x 0.5": _scaled_poses(0.5),
    "poses in mm": _scaled_poses(1000),
}
