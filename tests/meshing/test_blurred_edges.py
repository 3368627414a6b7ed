"""Depth that was smoothed over edges is told from depth that was not, and loses what lies between two surfaces."""

import cv2
import numpy as np
import pytest

from spslam.errors import DatasetError
from spslam.meshing.blurred_edges import edges_are_blurred, without_blurred_edges

NOISE = 4e-6, 1e-6
NEAR_M, FAR_M = 1.0, 2.0


def boxes(sigma_px=0.0, seed=0):
    """A wall with boxes before it, some of them at the border."""
    generator = np.random.default_rng(seed)
    depth = np.full((96, 128), FAR_M, np.float32)
    for u, v in generator.integers(0, 90, (6, 2)):
        depth[v : v + 24, u : u + 24] = NEAR_M
    return cv2.GaussianBlur(depth, (0, 0), sigma_px) if sigma_px else depth


@pytest.mark.parametrize(("sigma_px", "blurred"), [(0.0, False), (0.4, False), (1.2, True), (1.6, True)])
def test_smoothed_edges_are_found(sigma_px, blurred):
    assert edges_are_blurred([boxes(sigma_px, seed) for seed in range(3)], NOISE) == blurred


def test_a_steep_surface_is_no_edge():
    depth = 1 / (1 / NEAR_M - np.arange(128, dtype=np.float32)[None] * np.ones((96, 1), np.float32) * 6e-3)
    assert not edges_are_blurred([depth], NOISE)
    assert np.array_equal(without_blurred_edges(depth, NOISE), depth)


def test_what_lies_between_two_surfaces_is_left_out():
    sharp, smooth = boxes(), boxes(1.2)
    kept = without_blurred_edges(smooth, NOISE)
    known = kept > 0
    between = (np.abs(smooth - NEAR_M) > 0.1) & (np.abs(smooth - FAR_M) > 0.1)
    assert between.sum() > 500 and (known & between).sum() < 0.02 * between.sum()
    assert np.array_equal(kept[known], smooth[known])
    away = cv2.dilate((cv2.Laplacian(sharp, cv2.CV_32F) != 0).astype(np.uint8), np.ones((11, 11))) == 0
    assert known[away].all()


def test_a_ramp_into_the_unknown_is_left_out():
    """As at the end of a sensor's range."""
    smooth = boxes(1.2)
    cut = np.where(smooth > 1.9, 0, smooth).astype(np.float32)
    kept = without_blurred_edges(cut, NOISE)
    assert (kept > 1.2).sum() < 0.1 * (cut > 1.2).sum()


def test_little_is_not_enough_to_judge():
    class Broken(list):
        def __getitem__(self, position):
            raise DatasetError("can't be read")

    empty = np.zeros((0, 0), np.float32)
    assert not edges_are_blurred([], NOISE)
    assert not edges_are_blurred(Broken([boxes(1.2)]), NOISE)
    assert not edges_are_blurred([empty, np.zeros((4, 5), np.float32)], NOISE)
    assert without_blurred_edges(empty, NOISE).shape == (0, 0)
    flat = np.full((40, 50), np.nan, np.float32)
    flat[:, 10:] = FAR_M
    assert np.array_equal(without_blurred_edges(flat, NOISE)[:, 10:], flat[:, 10:])
