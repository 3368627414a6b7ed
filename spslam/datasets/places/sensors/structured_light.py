"""A structured-light sensor like the Kinect v1: disparity noise, quantization, shadows and missing edges.

Khoshelham and Elberink, Accuracy and Resolution of Kinect Depth Data, Sensors 12 (2012): depth is f b / d for a
disparity d measured in steps of 1/8 px, so that its error is (z^2 / f b) sigma_d. Nguyen, Izadi and Lovell, Modeling
Kinect Sensor Noise, 3DIMPVT 2012: the error at 0.4 to 3 m, pixels lost on steep surfaces, and the sideways noise of
edges. Noise, edges and steepness are `spslam.datasets.depth_noise.kinect_depth`; the shadow is the part of the scene
that the camera sees and the projector beside it doesn't light.
"""

from __future__ import annotations

import numpy as np

from spslam.camera import Camera
from spslam.datasets.depth_noise import kinect_depth
from spslam.datasets.places.sensors.occlusion import occluded

BASELINE_M = 0.075
# A surface must hide another by this much in the projector's image, or its own slope would count as a shadow.
_HIDDEN_PX = 0.5


def measure_structured_light(
    depth: np.ndarray, color: np.ndarray, camera: Camera, level: float, generator: np.random.Generator
) -> np.ndarray:
    """Depth as the sensor would measure it, float32 [H, W], m, 0 where nothing was measured.

    Args:
        depth: float32 [H, W], m, exact.
        color: uint8 [H, W, 3]; not used, as the sensor brings its own light.
        camera: of the image.
        level: 1 is the sensor, 0 exact.
        generator: decides on everything.
    """
    measured = kinect_depth(depth, camera.fx, level, generator)
    disparity = np.float32(camera.fx * BASELINE_M * min(level, 1.0)) / depth
    measured[occluded(disparity, _HIDDEN_PX * depth.shape[1] / 640)] = 0
    return measured
