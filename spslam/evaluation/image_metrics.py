"""PSNR and SSIM: rendered color images against input images."""

from __future__ import annotations

import cv2
import numpy as np

# Wang et al. 2004: a Gaussian window with a standard deviation of 1.5 px and a radius of 5 px; C1 and C2 avoid a
# division by 0.
_SIGMA_PX, _RADIUS_PX = 1.5, 5
_C1, _C2 = (0.01 * 255) ** 2, (0.03 * 255) ** 2


def psnr_db(rendered: np.ndarray, reference: np.ndarray, mask: np.ndarray | None = None) -> float:
    """Peak signal-to-noise ratio in dB, `10 log10(255^2 / MSE)`.

    Args:
        rendered: uint8 [H, W, 3].
        reference: uint8 [H, W, 3].
        mask: bool [H, W], pixels to compare; all by default.

    Returns:
        Infinity for equal images, NaN for an empty mask.

    Raises:
        ValueError: images of different shapes.
    """
    if rendered.shape != reference.shape:
        raise ValueError(
            f"psnr_db: rendered and reference must have the same shape, got {rendered.shape} and {reference.shape}"
        )
    squared = (rendered.astype(np.float64) - reference) ** 2
    if mask is not None:
        squared = squared[mask]
    if not squared.size:
        return float("nan")
    error = float(squared.mean())
    return float("inf") if error == 0 else 10 * float(np.log10(255**2 / error))


def ssim(rendered: np.ndarray, reference: np.ndarray, mask: np.ndarray | None = None) -> float:
    """Structural similarity (Wang et al. 2004), averaged over pixels and channels.

    `(2 mx my + C1)(2 sxy + C2) / ((mx^2 + my^2 + C1)(sx^2 + sy^2 + C2))` with means, variances and covariance under a
    Gaussian window with a standard deviation of 1.5 px and a radius of 5 px. Only pixels whose whole window lies in the
    image, and in the mask, are used.

    Args:
        rendered: uint8 [H, W, 3].
        reference: uint8 [H, W, 3].
        mask: bool [H, W], pixels to compare; all by default.

    Returns:
        At most 1; NaN without a pixel to compare.

    Raises:
        ValueError: images of different shapes.
    """
    if rendered.shape != reference.shape:
        raise ValueError(
            f"ssim: rendered and reference must have the same shape, got {rendered.shape} and {reference.shape}"
        )
    allowed = np.ones(rendered.shape[:2], dtype=np.uint8) if mask is None else mask.astype(np.uint8)
    window = np.ones((2 * _RADIUS_PX + 1, 2 * _RADIUS_PX + 1), dtype=np.uint8)
    counted = cv2.erode(allowed, window, borderType=cv2.BORDER_CONSTANT, borderValue=0)
    if not counted.any():
        return float("nan")
    x, y = rendered.astype(np.float64), reference.astype(np.float64)
    mean_x, mean_y = _blurred(x), _blurred(y)
    variance_x, variance_y = _blurred(x * x) - mean_x**2, _blurred(y * y) - mean_y**2
    covariance = _blurred(x * y) - mean_x * mean_y
    similarity = (2 * mean_x * mean_y + _C1) * (2 * covariance + _C2)
    similarity /= (mean_x**2 + mean_y**2 + _C1) * (variance_x + variance_y + _C2)
    return float(similarity[counted > 0].mean())


def _blurred(image: np.ndarray) -> np.ndarray:
    size = 2 * _RADIUS_PX + 1
    return cv2.GaussianBlur(image, (size, size), _SIGMA_PX, borderType=cv2.BORDER_REFLECT)
