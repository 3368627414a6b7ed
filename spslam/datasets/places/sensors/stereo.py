"""An active stereo camera like the Intel RealSense D435: sub-pixel noise, fattened edges, texture.

Keselman et al., Intel RealSense Stereoscopic Depth Cameras, CVPR workshops 2017, and Grunnet-Jepsen, Sweetser and
Woodfill, Best-Known-Methods for Tuning Intel RealSense D400 Depth Cameras, Intel 2018: the error of depth is
z^2 s / (f b), with a baseline b of 50 mm and a sub-pixel error s of 0.08 px (the paper's and the guide's value for a
well-textured wall). Block matching correlates neighboring pixels and fattens near edges by half a window; pixels that
only one camera sees, a band at the left border included, and ones without texture are missing. The infrared projector's
pattern adds texture that fades with the square of depth.
"""

from __future__ import annotations

import cv2
import numpy as np

from spslam.camera import Camera
from spslam.datasets.places.sensors.noise import smooth_noise
from spslam.datasets.places.sensors.occlusion import occluded

BASELINE_M = 0.05
SUBPIXEL = 0.08
# Pixels are those of a width of 848 px, the sensor's best; smaller images are decimated from it. Correlation of the
# error, and reach of a near edge.
_WINDOW_SIGMA_PX, _FAT_PX, FULL_WIDTH_PX = 3.0, 3.0, 848
# A surface must hide another by this much in the right image, or its own slope would.
_HIDDEN_PX = 0.5
# Larger steps of disparity are edges.
_EDGE_PX = 0.75
# Texture is the mean gradient (levels per px) in a window; with `_GOOD_TEXTURE` the error is the stated one, below
# `_NO_TEXTURE` the pixel is lost.
_PROJECTOR_TEXTURE, _PROJECTOR_RANGE_M = 14.0, 3.0
_GOOD_TEXTURE, _NO_TEXTURE = 4.0, 1.0
_RANDOM_LOSS = 0.003


def measure_stereo(
    depth: np.ndarray, color: np.ndarray, camera: Camera, level: float, generator: np.random.Generator
) -> np.ndarray:
    """Depth as the sensor would measure it, float32 [H, W], m, 0 where nothing was measured.

    Args:
        depth: float32 [H, W], m, exact.
        color: uint8 [H, W, 3] of the same view; its texture is what is matched.
        camera: of the image.
        level: 1 is the sensor, 0 exact.
        generator: decides on everything.
    """
    scale = depth.shape[1] / FULL_WIDTH_PX
    disparity_px_m = np.float32(camera.fx * BASELINE_M)
    exact = disparity_px_m / depth
    radius = round(_FAT_PX * scale * min(level, 1.0))
    disparity = _fattened(exact, radius) if radius else exact
    texture = texture_of(color, disparity_px_m / disparity)
    deviation = np.float32(level * SUBPIXEL * scale) * np.clip(_GOOD_TEXTURE / np.maximum(texture, 1e-3), 1, 3)
    noisy = disparity + deviation * smooth_noise(depth.shape, _WINDOW_SIGMA_PX * scale, generator)
    lost = (_unmatched(exact) & (disparity == exact)) | (texture < _NO_TEXTURE) | (noisy <= 0)
    lost |= generator.random(depth.shape, dtype=np.float32) < _RANDOM_LOSS * level
    return np.where(lost, np.float32(0), disparity_px_m / np.where(noisy <= 0, np.float32(1), noisy))


def _fattened(disparity: np.ndarray, radius: int) -> np.ndarray:
    """Near surfaces reach over their edges; slopes stay as they are."""
    near = cv2.dilate(disparity, np.ones((1, 2 * radius + 1), np.uint8))
    return np.where(near - disparity > _EDGE_PX, near, disparity)


def texture_of(color: np.ndarray, depth: np.ndarray) -> np.ndarray:
    """What can be matched: mean gradient in levels per px with the projector's pattern, float32 [H, W]."""
    gray = cv2.cvtColor(color, cv2.COLOR_RGB2GRAY)
    gradient = cv2.convertScaleAbs(cv2.Sobel(gray, cv2.CV_16S, 1, 0, scale=1 / 8))
    projected = np.float32(_PROJECTOR_TEXTURE) / (1 + (depth / np.float32(_PROJECTOR_RANGE_M)) ** 2) ** 2
    return cv2.boxFilter(gradient, cv2.CV_32F, (9, 9)) + projected


def _unmatched(disparity: np.ndarray) -> np.ndarray:
    """Pixels whose point is outside the right image or hidden in it: they lie to the left of near surfaces."""
    outside = np.arange(disparity.shape[1], dtype=np.float32) - disparity < -0.5
    return occluded(disparity, _HIDDEN_PX) | outside
