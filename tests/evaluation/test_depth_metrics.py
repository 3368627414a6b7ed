import numpy as np
import pytest

from spslam.evaluation.depth_metrics import depth_l1


def test_depth_l1_is_the_mean_over_views_of_the_mean_over_pixels():
    reference = np.array([[1.0, 2.0], [0.0, np.nan]])
    first = (np.array([[1.02, 2.0], [5.0, 5.0]]), reference)
    second = (np.array([[1.0, 0.0], [1.0, 1.0]]), reference + 0.04)
    metrics = depth_l1([first, second])
    assert metrics["depth_l1_cm"] == pytest.approx((1 + (4 + 96) / 2) / 2)
    assert metrics["depth_l1_coverage"] == pytest.approx(100 * 4 / 5)


def test_depth_l1_without_views_or_pixels():
    assert depth_l1([]) == {}
    assert depth_l1([(np.zeros((2, 2)), np.ones((2, 2)))]) == {}
    with pytest.raises(ValueError, match="depth_l1: estimated and reference must have the same shape"):
        depth_l1([(np.zeros((2, 2)), np.ones((2, 3)))])
