"""Pixels that mix two surfaces are found, and a recording is told that has them."""

import cv2
import numpy as np
import pytest

from spslam.errors import DatasetError
from spslam.meshing.flying_pixels import flying_pixels, has_flying_pixels
from tests.meshing.test_blurred_edges import FAR_M, NEAR_M, NOISE, boxes

# Of a pixel's footprint relative to its size, as of the time-of-flight camera.
FOOTPRINT_PX = 0.6


def mixed(seed=0):
    return cv2.GaussianBlur(boxes(seed=seed), (3, 3), FOOTPRINT_PX)


def test_what_lies_between_two_surfaces_is_found():
    depth = mixed()
    found = flying_pixels(depth, NOISE)
    between = (depth > NEAR_M * 1.1) & (depth < FAR_M / 1.1)
    assert between.sum() > 300 and found[between].mean() > 0.9  # not all corners
    assert not found[(depth == NEAR_M) | (depth == FAR_M)].any()


def test_both_axes_are_alike():
    depth = mixed()
    assert np.array_equal(flying_pixels(np.ascontiguousarray(depth.T), NOISE), flying_pixels(depth, NOISE).T)


def test_sharp_edges_steep_surfaces_and_noise_have_none():
    steep = 1 / (1 / NEAR_M - np.arange(128, dtype=np.float32)[None] * np.ones((96, 1), np.float32) * 6e-3)
    noisy = FAR_M + 0.005 * np.random.default_rng(0).standard_normal((96, 128)).astype(np.float32)
    for depth in (boxes(), steep, noisy):
        assert not flying_pixels(depth, NOISE).any()


@pytest.mark.parametrize("width_px", [1, 2, 3])
def test_a_step_between_two_others_is_a_surface_from_three_pixels_on(width_px):
    depth = np.full((8, 32), NEAR_M, np.float32)
    depth[:, 16:] = FAR_M
    depth[:, 16 : 16 + width_px] = 1.4
    assert flying_pixels(depth, NOISE).any() == (width_px < 3)


def test_a_recording_is_judged_by_its_edges():
    assert has_flying_pixels([mixed(seed) for seed in range(3)], NOISE)
    assert not has_flying_pixels([boxes(seed=seed) for seed in range(3)], NOISE)


def test_treads_of_a_stair_are_no_flying_pixels():
    """Some are one or two pixels wide, between others that are wider."""
    widths = (6, 1, 6, 6, 2, 6, 6, 3, 6)
    rows = np.repeat(NEAR_M + 0.2 * np.arange(len(widths), dtype=np.float32), widths)
    depth = np.tile(rows[:, None], (1, 100))
    assert flying_pixels(depth, NOISE).any() and not has_flying_pixels([depth], NOISE)


def test_little_is_not_enough_to_judge():
    class Broken(list):
        def __getitem__(self, position):
            raise DatasetError("can't be read")

    assert not has_flying_pixels([], NOISE)
    assert not has_flying_pixels(Broken([mixed()]), NOISE)
    assert not has_flying_pixels([np.zeros((0, 0), np.float32), np.zeros((4, 5), np.float32)], NOISE)
    assert flying_pixels(np.zeros((0, 0), np.float32), NOISE).shape == (0, 0)
