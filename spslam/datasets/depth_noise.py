"""The errors of a Kinect v1, applied to exact depth."""

from __future__ import annotations

import cv2
import numpy as np

# Focal length times baseline of the sensor at 640 px: disparity = this / depth.
_DISPARITY_PX_M = 43.5
_DISPARITY_STEP_PX = 1 / 8
_DISPARITY_SD_PX = 0.3 / 8
# Neighboring pixels err alike, because the sensor matches windows of some 7 px.
_CORRELATION_PX = 2.5
_CORRELATED_SHARE = 0.9
_WANDER_PX = 0.6
_RANGE_M = (0.35, 8.0)
_GRAZING_TANGENT = np.tan(np.radians(80))
_EDGE_LOSS = 0.6
_RANDOM_LOSS = 0.002


def kinect_depth(depth: np.ndarray, focal_px: float, level: float, generator: np.random.Generator) -> np.ndarray:
    """Depth as a structured-light sensor would measure it.

    Disparity noise, mostly correlated over a few pixels, and its quantization give an error that grows with depth
    squared: RMS 0.12 cm z^2, z in m, over surfaces at all depths (0.12 cm at 1 m, 0.75 cm at 2.5 m). The deviation on
    one flat wall that faces the camera is 0.09 to 0.145 cm z^2, by where its disparity lies between two steps. Edges
    wander sideways; pixels are missing at depth edges, on surfaces seen under more than 80 degrees, outside 0.35 to
    8 m, and now and then anywhere.

    Args:
        depth: float32 [H, W], m, exact depth, all above 0.
        focal_px: the camera's focal length; lengths in the image scale with the width.
        level: 1 is the sensor, 0 none; scales the errors and the loss of pixels.
        generator: decides on everything; the same state gives the same image.

    Returns:
        float32 [H, W], m, 0 where nothing was measured.
    """
    if level == 0:
        return depth.copy()
    scale = depth.shape[1] / 640
    wandered = _wander(depth, level * _WANDER_PX * scale, scale, generator)
    white = generator.standard_normal(depth.shape, dtype=np.float32)
    noise = np.sqrt(1 - _CORRELATED_SHARE) * white
    noise += np.sqrt(_CORRELATED_SHARE) * _correlated_noise(depth.shape, scale, generator)
    disparity = _DISPARITY_PX_M / wandered + np.float32(level * _DISPARITY_SD_PX) * noise
    step = np.float32(level * _DISPARITY_STEP_PX)
    disparity = np.maximum(np.round(disparity / step), 1) * step
    measured = (_DISPARITY_PX_M / disparity).astype(np.float32)
    measured[_lost(wandered, focal_px, min(level, 1.0), generator)] = 0
    return measured


def _wander(depth: np.ndarray, amplitude_px: float, scale: float, generator: np.random.Generator) -> np.ndarray:
    grid = np.indices(depth.shape, dtype=np.float32)
    columns = grid[1] + np.float32(amplitude_px) * _correlated_noise(depth.shape, scale, generator)
    rows = grid[0] + np.float32(amplitude_px) * _correlated_noise(depth.shape, scale, generator)
    return cv2.remap(depth, columns, rows, cv2.INTER_NEAREST, borderMode=cv2.BORDER_REPLICATE)


def _correlated_noise(shape: tuple[int, ...], scale: float, generator: np.random.Generator) -> np.ndarray:
    sigma = max(_CORRELATION_PX * scale, 0.5)
    noise = cv2.GaussianBlur(generator.standard_normal(shape, dtype=np.float32), (0, 0), sigma)
    return (noise / noise.std()).astype(np.float32)


def _lost(depth: np.ndarray, focal_px: float, share: float, generator: np.random.Generator) -> np.ndarray:
    x, y = (cv2.Sobel(depth, cv2.CV_32F, *order, scale=1 / 8) for order in ((1, 0), (0, 1)))
    gradient = np.sqrt(x**2 + y**2)  # bits of cv2.magnitude depend on where in memory these are
    steep = gradient * np.float32(focal_px) > np.float32(_GRAZING_TANGENT) * depth
    chance = np.where(steep, np.float32(_EDGE_LOSS * share), np.float32(_RANDOM_LOSS * share))
    out_of_range = (depth < _RANGE_M[0]) | (depth > _RANGE_M[1])
    return out_of_range | (generator.random(depth.shape, dtype=np.float32) < chance)
