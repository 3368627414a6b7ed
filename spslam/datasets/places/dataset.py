"""Sequences of generated places with exact ground truth, any length, frame by frame."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from spslam.datasets.base import MAX_FRAMES, RgbdDataset, RgbdFrame
from spslam.datasets.clock import AT_ONCE, CaptureOffsets, capture_offsets, capture_times
from spslam.datasets.images import check_image_size
from spslam.datasets.places.color_image import ColorImage, ExposureMeter
from spslam.datasets.places.motion import MOTIONS, Motion
from spslam.datasets.places.people import MOST_PEOPLE, People
from spslam.datasets.places.registry import PLACES, make_place
from spslam.datasets.places.sensors import SENSORS
from spslam.datasets.solids import SolidScene
from spslam.errors import DatasetError

_SMALLEST_IMAGE = 16
RATES_HZ = (1.0, 120.0)


@dataclass(frozen=True)
class Capture:
    """How images are taken.

    Attributes:
        width: px; None is the sensor's.
        height: px; None is the sensor's.
        rate_hz: frames per second; None is the sensor's.
        sensor_noise: scale of the sensor's errors: 0 exact, 1 the sensor.
        color_noise: standard deviation of color noise at middle gray, 0 to 255.
        exposure_ms: of the color image, which blurs with motion.
        auto_exposure: whether brightness follows the scene's, and dark and bright parts are clipped.
        rolling_shutter_ms: read-out time from the first row to the last, of color and depth.
        color_delay_ms: from depth to color of the same frame; negative where color comes first.
        color_rate_hz: of a color camera that runs on its own, whose image nearest in time a frame has; None takes one
            with each depth image.
        stamp_jitter_ms: each image's stamp is late by up to so much, as if given on arrival.
    """

    width: int | None = None
    height: int | None = None
    rate_hz: float | None = None
    sensor_noise: float = 1.0
    color_noise: float = 0.0
    exposure_ms: float = 0.0
    auto_exposure: bool = False
    rolling_shutter_ms: float = 0.0
    color_delay_ms: float = 0.0
    color_rate_hz: float | None = None
    stamp_jitter_ms: float = 0.0

    def check(self) -> None:
        """Raises DatasetError for a number out of range."""
        sizes = [("width", _SMALLEST_IMAGE, MAX_FRAMES), ("height", _SMALLEST_IMAGE, MAX_FRAMES)]
        ranges = [("sensor_noise", 0, 100), ("color_noise", 0, 255), ("exposure_ms", 0, 1000)]
        ranges += [("rolling_shutter_ms", 0, 1000), ("color_delay_ms", -1000, 1000)]
        ranges += [("stamp_jitter_ms", 0, 1000)]
        for name, low, high in [*sizes, ("rate_hz", *RATES_HZ), ("color_rate_hz", *RATES_HZ), *ranges]:
            value = getattr(self, name)
            if value is not None and not low <= value <= high:
                raise DatasetError(f"dataset.{name} must be from {low:g} to {high:g}, got {value}")


# What is set when a dataset is opened.
_SET_LATER = ("depth_range", "border_px", "left_out")


class PlacesDataset(RgbdDataset):
    """Frames of a generated place; the same arguments give the same bytes, in any order of reading.

    Args:
        place: one of `PLACES`.
        motion: one of `MOTIONS`.
        sensor: one of `SENSORS`.
        frames: number of frames; beyond one round of the place the camera goes round again.
        seed: of place, motion and noise.
        texture: contrast of all patterns and pictures, 0 to 1.
        capture: image size, rate, and effects.
        people: who walk on the camera's way, 0 to `MOST_PEOPLE`; not at a desk.

    Attributes:
        place: the `Place`, for evaluation: `signed_distance`, `sample_surface`, `mesh`.
        motion: the `Motion`; `motion.pose(t)` is the camera's true pose at any time.

    Raises:
        DatasetError: an unknown name, or a number out of range.
    """

    def __init__(
        self,
        place: str = "room",
        motion: str = "handheld",
        sensor: str = "exact",
        frames: int = 300,
        seed: int = 0,
        texture: float = 1.0,
        capture: Capture | None = None,
        people: int = 0,
    ) -> None:
        for option, name, known in (("place", place, PLACES), ("motion", motion, MOTIONS), ("sensor", sensor, SENSORS)):
            if name not in known:
                raise DatasetError(f"dataset.{option} must be one of {', '.join(known)}, got {name}")
        numbers = [("frames", frames, 1, MAX_FRAMES), ("seed", seed, 0, 2**63 - 1), ("texture", texture, 0, 1)]
        numbers.append(("people", people, 0, MOST_PEOPLE))
        for option, value, low, high in numbers:
            if not low <= value <= high:
                raise DatasetError(f"dataset.{option} must be from {low} to {high}, got {value}")
        if people and place == "desk":
            raise DatasetError(
                "dataset.people must be 0 at a desk, where nobody walks by; choose another dataset.place"
            )
        self._arguments = (place, motion, sensor, frames, seed, texture, capture, people)
        self._capture = Capture() if capture is None else capture
        self._capture.check()
        self._sensor = SENSORS[sensor]
        self.camera = self._sensor.camera(self._capture.width, self._capture.height)
        check_image_size((self.camera.width, self.camera.height), "dataset.width and dataset.height")
        self.name = f"{place}-{motion}-{sensor}-{seed}"
        self.place = make_place(place, seed, texture)
        self.motion = Motion(self.place.route, motion, seed, self.place.pace)
        self._people = People(people, self.motion, seed, texture)
        self._rate_hz = self._sensor.rate_hz if self._capture.rate_hz is None else self._capture.rate_hz
        self._frames, self._seed = int(frames), int(seed)
        self._times = np.arange(self._frames) / self._rate_hz
        # The color images that its camera takes, and which of them each frame has.
        color_rate_hz = self._capture.color_rate_hz or self._rate_hz
        self._colors = np.round(self._times * color_rate_hz).astype(np.int64)
        self._color_times = np.arange(self._colors[-1] + 1) / color_rate_hz
        self._stamps, self._offsets = self._stamped()
        meter = ExposureMeter(self.place, self.motion, self.camera) if self._capture.auto_exposure else None
        self._color = ColorImage(self.camera, self._capture.color_noise, self._capture.exposure_ms / 1000, meter)

    def __reduce__(self) -> tuple:
        """Another process makes the place again: that is less than its textures are."""
        return type(self), self._arguments, {name: getattr(self, name) for name in _SET_LATER}

    def __len__(self) -> int:
        return self._frames

    def timestamps(self) -> np.ndarray:
        return self._stamps.copy()

    def poses(self) -> np.ndarray:
        """Poses at the times of depth images, not of their stamps; with a rolling shutter, of their middle row."""
        return self.motion.poses(self._times)

    @property
    def surface(self) -> SolidScene:
        return self.place

    def read(self, index: int) -> RgbdFrame:
        time = float(self._times[index])
        color_time = float(self._color_times[self._colors[index]]) + self._capture.color_delay_ms / 1000
        generator = np.random.default_rng([self._seed, 41, index])
        color, exact = self._render(color_time)
        seen = color
        color = self._color.take(color, exact, (self.motion, color_time), generator)
        if color_time != time:
            seen, exact = self._render(time)
        depth = self._sensor.read(exact, seen, self.camera, self._capture.sensor_noise, generator)
        return RgbdFrame(index, float(self._stamps[index]), color, depth, self.motion.pose(time), self._offsets[index])

    def _stamped(self) -> tuple[np.ndarray, list[CaptureOffsets]]:
        """The stamps of the depth images, [F], and what both images' stamps say of when they were taken."""
        capture = self._capture
        if capture.color_rate_hz is None and capture.stamp_jitter_ms == 0:
            return self._times, [AT_ONCE] * self._frames
        generator, most_s = np.random.default_rng([self._seed, 43]), capture.stamp_jitter_ms / 1000
        # Stamps do not know of a constant delay.
        color = np.maximum.accumulate(self._color_times + generator.uniform(0, most_s, len(self._color_times)))
        stamps = np.maximum.accumulate(self._times + generator.uniform(0, most_s, self._frames))
        return stamps, capture_offsets(stamps, capture_times(color)[self._colors], capture_times(stamps))

    def _render(self, time: float) -> tuple[np.ndarray, np.ndarray]:
        """Sharp color uint8 [H, W, 3] and exact depth float32 [H, W], m, of an image whose middle row is of a time."""
        readout, height = self._capture.rolling_shutter_ms / 1000, self.camera.height
        rows = (np.arange(height) + 0.5) / height - 0.5 if readout else np.zeros(1)
        times = time + readout * rows
        image = self.place.render(self.camera, self.motion.poses(times))
        self._people.add(image, self.camera, times)
        return image
