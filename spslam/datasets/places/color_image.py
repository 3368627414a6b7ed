"""What a color camera does to an image: exposure, motion blur and noise."""

from __future__ import annotations

import cv2
import numpy as np

from spslam.camera import Camera
from spslam.datasets.places.motion import Motion
from spslam.datasets.places.place import Place
from spslam.geometry import inverse

# Of an image's mean that automatic exposure aims at, 0 to 255, and how it gets there.
_TARGET = 118.0
_METER_STEP_S, _METER_STEPS, _METER_DECAY = 0.15, 6, 0.6
_GAINS = (0.4, 2.5)
_METER_WIDTH_PX = 24
# Display values are light to the power of 1 / this.
_GAMMA = 2.2
_MOST_BLUR_SAMPLES = 24
# Noise of a pixel has a part that light brings (photons) and one that it doesn't; at middle gray, variance splits so.
_SHOT_SHARE, _MIDDLE_GRAY = 0.8, 118.0


class ExposureMeter:
    """Automatic exposure: the gain at a time follows the brightness of the second before, smoothed.

    Brightness is that of small images at fixed times, so that any frame can be taken first.

    Args:
        place: what is seen.
        motion: of the camera.
        camera: of the images.
    """

    def __init__(self, place: Place, motion: Motion, camera: Camera) -> None:
        self._place, self._motion = place, motion
        self._camera = camera.resized(_METER_WIDTH_PX, max(round(_METER_WIDTH_PX * camera.height / camera.width), 2))
        self._measured: dict[int, float] = {}

    def gain(self, time: float) -> float:
        """The factor on display values at a time in seconds."""
        step = int(np.floor(time / _METER_STEP_S))
        share = time / _METER_STEP_S - step
        weights = _METER_DECAY ** np.arange(_METER_STEPS)
        now, before = (
            np.dot(weights, [self._log_light(first - lag) for lag in range(_METER_STEPS)]) / weights.sum()
            for first in (step, step - 1)
        )
        return float(np.clip(_TARGET / np.exp(share * now + (1 - share) * before), *_GAINS))

    def _log_light(self, step: int) -> float:
        if step not in self._measured:
            color, _ = self._place.render(self._camera, self._motion.pose(step * _METER_STEP_S))
            self._measured[step] = float(np.log(max(color.mean(), 1.0)))
        return self._measured[step]


class ColorImage:
    """Turns a sharp, clean image into what the camera stores.

    Args:
        camera: of the image.
        noise: standard deviation of the noise at middle gray, 0 to 255. Its variance is a I + b (Foi et al., Practical
            Poissonian-Gaussian noise modeling, IEEE TIP 2008).
        exposure_s: the image is the mean over this time, around its time stamp.
        meter: automatic exposure; None for none.
    """

    def __init__(self, camera: Camera, noise: float, exposure_s: float, meter: ExposureMeter | None) -> None:
        self._camera, self._noise, self._exposure_s, self._meter = camera, noise, exposure_s, meter

    def take(
        self, color: np.ndarray, depth: np.ndarray, when: tuple[Motion, float], generator: np.random.Generator
    ) -> np.ndarray:
        """The stored image uint8 [H, W, 3].

        Args:
            color: uint8 [H, W, 3], sharp.
            depth: float32 [H, W], m, exact, of the same view.
            when: the motion, and the time of the image's middle in seconds.
            generator: of the noise.
        """
        motion, time = when
        if self._exposure_s > 0:
            color = self._blurred(color, depth, motion, time)
        if self._meter is not None:
            color = cv2.convertScaleAbs(color, alpha=self._meter.gain(time))
        if self._noise > 0:
            color = self._with_noise(color, generator)
        return color

    def _blurred(self, color: np.ndarray, depth: np.ndarray, motion: Motion, time: float) -> np.ndarray:
        """The mean along each pixel's path through the image; light adds up before the display's gamma."""
        half = self._exposure_s / 2
        here, first, last = motion.poses(np.array([time, time - half, time + half]))
        points = self._camera.unproject(depth).reshape(-1, 3)
        start, end = (self._seen_from(inverse(pose) @ here, points) for pose in (first, last))
        longest = float(np.sqrt(((end - start) ** 2).sum(axis=-1).max()))
        count = int(np.clip(np.ceil(longest), 1, _MOST_BLUR_SAMPLES))
        light = _DISPLAY_TO_LIGHT[color]
        middle = np.stack(np.meshgrid(np.arange(color.shape[1]), np.arange(color.shape[0])), axis=-1).astype(np.float32)
        total = np.zeros_like(light)
        for share in (np.arange(count) + 0.5) / count:
            # What comes to this pixel at that time is where it was before, seen from now.
            moved = 2 * middle - ((1 - np.float32(share)) * start + np.float32(share) * end)
            total += cv2.remap(light, moved[..., 0], moved[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        display = (total / count) ** np.float32(1 / _GAMMA) * 255 + np.float32(0.5)
        return display.astype(np.uint8)

    def _seen_from(self, other_from_here: np.ndarray, points: np.ndarray) -> np.ndarray:
        moved = points @ other_from_here[:3, :3].T.astype(np.float32) + other_from_here[:3, 3].astype(np.float32)
        moved[:, 2] = np.maximum(moved[:, 2], 1e-3)
        return self._camera.project(moved).reshape(self._camera.height, self._camera.width, 2)

    def _with_noise(self, color: np.ndarray, generator: np.random.Generator) -> np.ndarray:
        deviation = np.float32(self._noise) * np.sqrt(
            np.float32(1 - _SHOT_SHARE) + np.float32(_SHOT_SHARE / _MIDDLE_GRAY) * np.arange(256, dtype=np.float32)
        )
        noise = generator.standard_normal(color.shape, dtype=np.float32)
        noise *= deviation[color]
        return cv2.add(noise, color, dtype=cv2.CV_8U)


_DISPLAY_TO_LIGHT = ((np.arange(256) / 255) ** _GAMMA).astype(np.float32)
