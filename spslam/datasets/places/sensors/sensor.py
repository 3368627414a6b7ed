"""The sensors by name: image size, field of view, rate, range and how each measures."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from spslam.camera import Camera
from spslam.datasets.places.sensors.phone_lidar import measure_phone_lidar
from spslam.datasets.places.sensors.stereo import measure_stereo
from spslam.datasets.places.sensors.structured_light import measure_structured_light
from spslam.datasets.places.sensors.time_of_flight import measure_time_of_flight

# Exact depth, color, camera, level and random numbers to measured depth.
Measure = Callable[[np.ndarray, np.ndarray, Camera, float, np.random.Generator], np.ndarray]


@dataclass(frozen=True)
class Sensor:
    """A depth sensor.

    Attributes:
        width: of its images, px.
        height: px.
        across_deg: horizontal field of view.
        rate_hz: frames per second.
        nearest_m: of the depth that it measures.
        farthest_m: of the depth that it measures.
        measure: its errors.
    """

    width: int
    height: int
    across_deg: float
    rate_hz: float
    nearest_m: float
    farthest_m: float
    measure: Measure

    def camera(self, width: int | None, height: int | None) -> Camera:
        """The camera for images of another size, or of the sensor's where None; the field of view across is kept."""
        width, height = self.width if width is None else width, self.height if height is None else height
        focal = 0.5 * width / math.tan(math.radians(self.across_deg / 2))
        return Camera(width, height, focal, focal, (width - 1) / 2, (height - 1) / 2)

    def read(
        self, depth: np.ndarray, color: np.ndarray, camera: Camera, level: float, generator: np.random.Generator
    ) -> np.ndarray:
        """Measured depth float32 [H, W], m, 0 outside the range; arguments as of `measure`."""
        measured = self.measure(depth, color, camera, level, generator) if level > 0 else depth.copy()
        measured[(measured < self.nearest_m) | (measured > self.farthest_m)] = 0
        return measured


def _measure_exact(
    depth: np.ndarray, color: np.ndarray, camera: Camera, level: float, generator: np.random.Generator
) -> np.ndarray:
    return depth.copy()


SENSORS: dict[str, Sensor] = {
    "exact": Sensor(320, 240, 60.0, 30.0, 0.0, math.inf, _measure_exact),
    "structured_light": Sensor(320, 240, 60.0, 30.0, 0.35, 8.0, measure_structured_light),
    "stereo": Sensor(424, 240, 87.0, 30.0, 0.2, 10.0, measure_stereo),
    "time_of_flight": Sensor(320, 288, 75.0, 30.0, 0.5, 5.5, measure_time_of_flight),
    "phone_lidar": Sensor(256, 192, 62.0, 60.0, 0.2, 5.0, measure_phone_lidar),
}
