"""Noise fields that the sensors share."""

from __future__ import annotations

import cv2
import numpy as np


def smooth_noise(shape: tuple[int, ...], sigma_px: float, generator: np.random.Generator) -> np.ndarray:
    """Gaussian noise of deviation 1 whose neighbors are alike over `sigma_px`; float32 [H, W]."""
    noise = generator.standard_normal(shape, dtype=np.float32)
    if sigma_px <= 0:
        return noise
    # A Gaussian kernel of sigma s sums independent pixels to a deviation of 1 / (2 sqrt(pi) s); exact from its weights,
    # as the borders reflect and small kernels are coarse.
    kernel = cv2.getGaussianKernel(2 * int(np.ceil(3 * sigma_px)) + 1, sigma_px, cv2.CV_32F)
    return cv2.sepFilter2D(noise, cv2.CV_32F, kernel, kernel) / np.float32(np.sum(kernel**2))
