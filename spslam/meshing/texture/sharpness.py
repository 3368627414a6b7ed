"""How sharp a color image is, measured at its own strong edges."""

from __future__ import annotations

import cv2
import numpy as np

# Edges are compared with themselves blurred by so much, px.
_COARSE_SIGMA_PX = 2.0
# The pixels of the strongest edges that are looked at, as a share of all, and the least slope of them, levels per px.
_STRONGEST, _LEAST_SLOPE = 0.05, 2.0


def sharpness(color: np.ndarray) -> float:
    """Mean ratio of the slope of strong edges to their slope after blurring: about 3 for steps, 1 where all is blurred.

    Args:
        color: uint8 [H, W, 3] RGB.

    Returns:
        The ratio; 1 for an image without edges. It does not depend on contrast or exposure. The same image gives the
        same bits.
    """
    gray = cv2.cvtColor(color, cv2.COLOR_RGB2GRAY).astype(np.float32)
    fine = _slope(cv2.GaussianBlur(gray, (0, 0), 0.5))
    coarse = _slope(cv2.GaussianBlur(gray, (0, 0), _COARSE_SIGMA_PX))
    bound = max(float(np.quantile(coarse[::2, ::2], 1 - _STRONGEST)), _LEAST_SLOPE)
    strong = coarse >= bound
    if not strong.any():
        return 1.0
    return float(fine[strong].sum() / coarse[strong].sum())


def _slope(gray: np.ndarray) -> np.ndarray:
    x, y = (cv2.Sobel(gray, cv2.CV_32F, *order, ksize=3, scale=0.125) for order in ((1, 0), (0, 1)))
    # Not cv2.magnitude, whose last bits depend on where in memory its arrays are.
    return cv2.sqrt(x * x + y * y)
