"""Depth L1: rendered depth images against ground truth."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np


def depth_l1(views: Iterable[tuple[np.ndarray, np.ndarray]]) -> dict[str, float]:
    """Mean absolute depth difference over views.

    Args:
        views: pairs (estimated, reference) of depth images of the same shape, meters, 0 or non-finite where there is
            none.

    Returns:
        `depth_l1_cm`: the mean over views of the mean difference over the pixels where both have depth.
        `depth_l1_coverage`: percentage of the reference's pixels with depth where the estimate has depth too; without
        it, a map that renders only a few pixels would score well.
        Empty if no view has a pixel to compare.

    Raises:
        ValueError: a pair of different shapes.
    """
    means, compared, known = [], 0, 0
    for estimated, reference in views:
        if estimated.shape != reference.shape:
            raise ValueError(
                f"depth_l1: estimated and reference must have the same shape, "
                f"got {estimated.shape} and {reference.shape}"
            )
        has_reference = np.isfinite(reference) & (reference > 0)
        both = has_reference & np.isfinite(estimated) & (estimated > 0)
        known += int(has_reference.sum())
        compared += int(both.sum())
        if both.any():
            means.append(np.mean(np.abs(estimated[both].astype(np.float64) - reference[both])))
    if not means:
        return {}
    return {"depth_l1_cm": 100 * float(np.mean(means)), "depth_l1_coverage": 100 * compared / known}
