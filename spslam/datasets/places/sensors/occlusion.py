"""What one of two views side by side does not see of the other."""

from __future__ import annotations

import numpy as np


def occluded(disparity: np.ndarray, least_px: float) -> np.ndarray:
    """Which pixels [H, W] a second view to the right, a camera's or a projector's, does not see.

    A nearer surface hides all that is left of its left edge by up to the difference of disparity, as if it had no right
    end. The shadow of things narrower than this difference is therefore too wide: in truth it is as wide as they are,
    and the second view sees what lies between them and it.

    Args:
        disparity: float32 [H, W], px, exact: a pixel's column less that of its point in the second view.
        least_px: how far a nearer surface must reach over a pixel's point in the second view, px; a surface's own slope
            reaches a little.
    """
    columns = np.arange(disparity.shape[1], dtype=np.float32) - disparity
    nearest = np.minimum.accumulate(columns[:, ::-1], axis=1)[:, ::-1]
    return columns > nearest + np.float32(least_px)
