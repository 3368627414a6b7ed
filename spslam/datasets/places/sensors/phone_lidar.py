"""The depth of a phone's LiDAR as ARKit gives it: 256 x 192 px, dense, smooth, few details.

The device times some 576 light spots (24 x 24) and a network spreads them over the image, guided by color. Luetzenburg,
Kroon and Bjork, Evaluation of the Apple iPhone 12 Pro LiDAR for an Application in Geosciences, Scientific Reports 11
(2021): an error of 1 cm on objects of 10 cm and more, smaller ones are lost, range 5 m. Baruch et al., ARKitScenes,
NeurIPS Datasets and Benchmarks 2021: depth beside a laser scanner's, smoothed at edges. Here spots with noise are
sampled, what lies between is interpolated, and exact depth is followed only where it departs by more than details do;
edges are a few pixels wide.
"""

from __future__ import annotations

import cv2
import numpy as np

from spslam.camera import Camera
from spslam.datasets.places.sensors.noise import smooth_noise

SPOTS = (24, 24)
# Deviation of a spot: a constant and a share of depth.
SPOT_M, SPOT_SHARE = 0.004, 0.004
# Edges of this size in depth survive, smaller ones are smoothed over the distance of the spots.
_DETAIL_M, _DETAIL_SHARE = 0.06, 0.03
_EDGE_SIGMA_PX, _FULL_WIDTH_PX = 1.2, 256


def measure_phone_lidar(
    depth: np.ndarray, color: np.ndarray, camera: Camera, level: float, generator: np.random.Generator
) -> np.ndarray:
    """Depth as ARKit would give it, float32 [H, W], m.

    Args:
        depth: float32 [H, W], m, exact.
        color: uint8 [H, W, 3]; not used.
        camera: of the image.
        level: 1 is the sensor, 0 exact; scales noise, detail and edge width.
        generator: decides on everything.
    """
    size = depth.shape[::-1]
    smooth = _smoothed_details(depth, level)
    sigma = _EDGE_SIGMA_PX * size[0] / _FULL_WIDTH_PX * min(level, 1.0)
    edges = cv2.GaussianBlur(smooth, (0, 0), max(sigma, 0.3))
    spots = smooth_noise(SPOTS[::-1], 0.0, generator)
    noise = cv2.resize(spots, size, interpolation=cv2.INTER_CUBIC)
    return (edges + np.float32(level) * (np.float32(SPOT_M) + np.float32(SPOT_SHARE) * edges) * noise).astype(
        np.float32
    )


def _smoothed_details(depth: np.ndarray, level: float) -> np.ndarray:
    """Depth without what is smaller than the distance of the spots, unless it stands out."""
    spot_px = max(depth.shape[1] / SPOTS[0], 1.0)
    diameter = 2 * int(spot_px / 2) + 1
    # 1/z is linear over a plane in the image, so that smoothing leaves planes as they are.
    inverse = 1 / depth
    coarse = 1 / cv2.blur(inverse, (diameter, diameter))
    reach = np.float32(level) * (np.float32(_DETAIL_M) + np.float32(_DETAIL_SHARE) * depth)
    departs = np.abs(coarse - depth) / reach
    keep = np.clip(departs - 0.5, 0, 1) if level > 0 else np.ones_like(depth)
    keep = cv2.blur(keep.astype(np.float32), (3, 3))
    return keep * depth + (1 - keep) * coarse
