"""A continuous-wave time-of-flight camera like the Azure Kinect: amplitude noise, wiggling, flying pixels.

Foix, Alenya and Torras, Lock-in Time-of-Flight Cameras: A Survey, IEEE Sensors Journal 11 (2011): the deviation of
depth is inverse to the amplitude, which falls with the square of the distance, with the cosine of incidence and with
reflectivity; non-sinusoidal modulation makes a periodic error ("wiggling", also Lindner et al., Time-of-Flight sensor
calibration for accurate range sensing, CVIU 114 (2010)). Keller and Kolb, Real-time simulation of time-of-flight
sensors, Simulation Modelling Practice and Theory 17 (2009): a pixel at an edge adds the phasors of both surfaces and
measures a point between them.

Size of the errors: Toelgyessy et al., Evaluation of the Azure Kinect and Its Comparison to Kinect V1 and Kinect V2,
Sensors 21 (2021): deviation 1 to 2 mm at 1 m and below 17 mm in the range, systematic error below 11 mm + 0.1 %. The
model's deviation is 0.5 mm z^2 / (r cos) for reflectivity r, 0.15 (black) to 1 (white), z in m and the cosine of
incidence. So 1 to 2 mm at 1 m hold for surfaces that face the camera with gray levels of 96 to 170; white has 0.5 mm,
black 3.3 mm. Below 17 mm hold up to 5.8 m sqrt(r cos): in the whole range for white alone (15 mm at 5.5 m), up to 3.4 m
for middle gray (level 128: 1.5, 13, 23 and 36 mm at 1, 3, 4 and 5 m) and up to 2.3 m for black, which is lost beyond
4.3 m. The systematic error is wiggling of 4 mm on all of them.
"""

from __future__ import annotations

import cv2
import numpy as np

from spslam.camera import Camera

# Deviation of depth at 1 m on a white surface seen at a right angle.
DEVIATION_M = 0.0005
WIGGLE_M, WIGGLE_PERIOD_M = 0.004, 0.47
# The phase's length: of the lowest of several frequencies, so that depth in the range is unique. What is farther than
# the most that is told apart measures as this, which is out of range: at low levels little of it is lost by amplitude.
_AMBIGUITY_M, _MOST_TOLD_APART_M = 18.0, 17.5
# A pixel's footprint relative to its size; mixed pixels are kept unless amplitude is lost.
_FOOTPRINT_PX = 0.6
_LEAST_AMPLITUDE = 0.008
_LARGEST_DEVIATION_M = 0.08


def measure_time_of_flight(
    depth: np.ndarray, color: np.ndarray, camera: Camera, level: float, generator: np.random.Generator
) -> np.ndarray:
    """Depth as the sensor would measure it, float32 [H, W], m, 0 where nothing was measured.

    Args:
        depth: float32 [H, W], m, exact.
        color: uint8 [H, W, 3] of the same view; its brightness stands for reflectivity.
        camera: of the image.
        level: 1 is the sensor, 0 exact; scales noise and wiggling, and mixes edges where above 0.
        generator: decides on everything.
    """
    strength = amplitude(depth, color, camera)
    lengths = np.linalg.norm(camera.ray_directions(), axis=2)
    distance = depth * lengths
    phase = np.minimum(distance, np.float32(_MOST_TOLD_APART_M)) * np.float32(2 * np.pi / _AMBIGUITY_M)
    mixed = [
        cv2.GaussianBlur(strength * wave(phase), (3, 3), _FOOTPRINT_PX * min(level, 1.0) + 1e-3)
        for wave in (np.cos, np.sin)
    ]
    measured = np.mod(np.arctan2(mixed[1], mixed[0]), 2 * np.pi) * np.float32(_AMBIGUITY_M / (2 * np.pi))
    received = np.sqrt(mixed[0] ** 2 + mixed[1] ** 2)  # bits of cv2.magnitude depend on where in memory these are
    deviation = np.minimum(DEVIATION_M / np.maximum(received, 1e-4), _LARGEST_DEVIATION_M)
    measured += np.float32(level * WIGGLE_M) * np.sin(np.float32(2 * np.pi / WIGGLE_PERIOD_M) * measured)
    measured += np.float32(level) * deviation * generator.standard_normal(depth.shape, dtype=np.float32)
    return np.where(received < _LEAST_AMPLITUDE * level, 0, measured / lengths).astype(np.float32)


def amplitude(depth: np.ndarray, color: np.ndarray, camera: Camera) -> np.ndarray:
    """Light that comes back, 1 from a white surface at 1 m and a right angle, float32 [H, W]."""
    reflectivity = (cv2.cvtColor(color, cv2.COLOR_RGB2GRAY) / np.float32(255)) ** np.float32(2.2)
    # Of infrared light dark dyes still return some.
    reflectivity = 0.15 + 0.85 * reflectivity
    return (reflectivity * _incidence(depth, camera) / np.maximum(depth, 0.1) ** 2).astype(np.float32)


def _incidence(depth: np.ndarray, camera: Camera) -> np.ndarray:
    """Cosine between the ray and the surface's normal, from the gradient of depth; 0.1 to 1."""
    rays = camera.ray_directions()
    across, down = _slope(depth, 1), _slope(depth, 0)
    # Normal of the surface z(u, v): tangents are d(z ray)/du and d(z ray)/dv.
    normal_x, normal_y = -across * np.float32(camera.fx), -down * np.float32(camera.fy)
    normal_z = depth + across * np.float32(camera.fx) * rays[..., 0] + down * np.float32(camera.fy) * rays[..., 1]
    length = np.sqrt(normal_x**2 + normal_y**2 + normal_z**2) * np.linalg.norm(rays, axis=2)
    dot = normal_x * rays[..., 0] + normal_y * rays[..., 1] + normal_z
    return np.clip(np.abs(dot) / np.maximum(length, 1e-6), 0.1, 1)


def _slope(depth: np.ndarray, axis: int) -> np.ndarray:
    """Difference to the next pixel or from the one before, whichever is smaller: an edge on one side doesn't count."""
    step = np.diff(depth, axis=axis)
    after = np.concatenate((step, step.take([-1], axis=axis)), axis=axis)
    before = np.concatenate((step.take([0], axis=axis), step), axis=axis)
    return np.where(np.abs(before) < np.abs(after), before, after)
