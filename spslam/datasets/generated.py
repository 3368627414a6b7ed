"""A sequence through a procedurally generated room, with exact ground truth; it needs no download.

A hand-held camera goes round a table in the middle of a furnished room and looks across it, so that every view holds
furniture before two walls and the floor. One round is 300 frames; the path doesn't depend on how many are asked for.
"""

from __future__ import annotations

import math

import numpy as np

from spslam.camera import Camera
from spslam.datasets.base import MAX_FRAMES, RgbdDataset, RgbdFrame
from spslam.datasets.depth_noise import kinect_depth
from spslam.datasets.images import check_image_size
from spslam.datasets.room import Room
from spslam.datasets.solids import SolidScene
from spslam.errors import DatasetError
from spslam.geometry import pose_from

FRAMES_PER_SECOND = 30.0
FRAMES_PER_ROUND = 300
# 60 degrees across, like a Kinect.
_FOCAL_PER_WIDTH = 0.5 / math.tan(math.radians(30))
_COLOR_NOISE_SD = 2.0
_SMALLEST_IMAGE = 16


class GeneratedDataset(RgbdDataset):
    """Frames of a generated room; the same arguments give the same bytes.

    Args:
        frames: number of frames.
        width: of the images, px; the field of view is 60 degrees across.
        height: of the images, px.
        noise: 0 is exact depth and clean color, 1 the errors of a Kinect v1 (`kinect_depth`) and slight color noise;
            True and False stand for 1 and 0.
        seed: decides on colors, small pieces of furniture, the shaking of the hand and the noise.

    Attributes:
        room: the `Room` seen, for evaluation: `signed_distance`, `sample_surface`, `mesh`.

    Raises:
        DatasetError: a number out of range.
    """

    name = "generated"

    def __init__(
        self, frames: int = 300, width: int = 320, height: int = 240, noise: float = 0.0, seed: int = 0
    ) -> None:
        for option, value, least in (
            ("frames", frames, 1),
            ("width", width, _SMALLEST_IMAGE),
            ("height", height, _SMALLEST_IMAGE),
            ("noise", noise, 0),
            ("seed", seed, 0),
        ):
            if not least <= value < float("inf"):
                raise DatasetError(f"dataset.{option} must be at least {least}, got {value}")
        check_image_size((width, height), "dataset.width and dataset.height")
        if frames > MAX_FRAMES:
            raise DatasetError(f"dataset.frames must be at most {MAX_FRAMES}, got {frames}")
        focal = _FOCAL_PER_WIDTH * width
        self.camera = Camera(width, height, focal, focal, (width - 1) / 2, (height - 1) / 2)
        self.room = Room(seed)
        self._noise = float(noise)
        self._seed = int(seed)
        self._poses = camera_path(frames, seed)

    def __len__(self) -> int:
        return len(self._poses)

    def timestamps(self) -> np.ndarray:
        return np.arange(len(self)) / FRAMES_PER_SECOND

    def poses(self) -> np.ndarray:
        return self._poses.copy()

    @property
    def surface(self) -> SolidScene:
        return self.room

    def read(self, index: int) -> RgbdFrame:
        pose = self._poses[index]
        color, depth = self.room.render(self.camera, pose)
        if self._noise > 0:
            generator = np.random.default_rng([self._seed, 4, index])
            depth = kinect_depth(depth, self.camera.fx, self._noise, generator)
            color = _with_noise(color, self._noise * _COLOR_NOISE_SD, generator)
        return RgbdFrame(index, index / FRAMES_PER_SECOND, color, depth, pose.copy())


def camera_path(frames: int, seed: int = 0) -> np.ndarray:
    """Poses [frames, 4, 4] of a hand-held round through the room; about 2 cm and 1.3 degrees per frame."""
    turn = 2 * np.pi * np.arange(frames) / FRAMES_PER_ROUND
    eye = np.stack((1.05 * np.cos(turn), 0.75 * np.sin(turn), 1.45 + 0.12 * np.sin(2 * turn + 1)), axis=1)
    heading = turn + np.pi + 0.22 * np.sin(3 * turn)
    pitch = -0.34 + 0.1 * np.sin(2 * turn)
    shake = _hand_shake(frames, seed)
    return np.stack(
        [
            _looking(position + moved, yaw + turned[0], up + turned[1], turned[2])
            for position, yaw, up, moved, turned in zip(eye, heading, pitch, shake[:, :3], shake[:, 3:], strict=True)
        ]
    )


def _hand_shake(frames: int, seed: int) -> np.ndarray:
    """Offsets [frames, 6]: m, then yaw, pitch and roll in radians; waves of 0.3 to 1.5 Hz."""
    generator = np.random.default_rng([seed, 5])
    frequency = generator.uniform(0.3, 1.5, (6, 4))
    phase = generator.uniform(0, 2 * np.pi, (6, 4))
    amplitude = np.array([0.006] * 3 + [0.008] * 3)[:, None] / frequency
    time = np.arange(frames)[:, None, None] / FRAMES_PER_SECOND
    return np.sum(amplitude * np.sin(2 * np.pi * frequency * time + phase), axis=2)


def _looking(eye: np.ndarray, yaw: float, pitch: float, roll: float) -> np.ndarray:
    forward = np.array([math.cos(pitch) * math.cos(yaw), math.cos(pitch) * math.sin(yaw), math.sin(pitch)])
    level_right = np.array([math.sin(yaw), -math.cos(yaw), 0.0])
    level_down = np.cross(forward, level_right)
    right = math.cos(roll) * level_right + math.sin(roll) * level_down
    return pose_from(np.stack((right, np.cross(forward, right), forward), axis=1), eye)


def _with_noise(color: np.ndarray, deviation: float, generator: np.random.Generator) -> np.ndarray:
    noisy = color + np.float32(deviation) * generator.standard_normal(color.shape, dtype=np.float32)
    return np.clip(noisy + 0.5, 0, 255).astype(np.uint8)
