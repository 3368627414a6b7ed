"""A frame's colors against the map's: which say yes, which no, and which nothing."""

import math

import numpy as np
import pytest
import torch

from spslam.slam.pixels import sample_frame
from spslam.slam.recovery.appearance import MIN_POINTS, brightness_correlation, brightness_sums
from spslam.slam.system import SlamSystem
from tests.system.sequences import Recorded, settings


def sums_of(mapped, seen):
    columns = (np.ones_like(mapped), mapped, seen, mapped**2, seen**2, mapped * seen)
    return [float(column.sum()) for column in columns]


def test_likeness_is_the_correlation():
    random = np.random.default_rng(0)
    mapped = random.uniform(0.2, 0.8, 500)
    seen = 0.5 * mapped + random.normal(0, 0.05, 500)
    assert brightness_correlation(*sums_of(mapped, seen)) == pytest.approx(np.corrcoef(mapped, seen)[0, 1])
    assert brightness_correlation(*sums_of(mapped, 1 - seen)) == pytest.approx(-np.corrcoef(mapped, seen)[0, 1])


def test_exposure_makes_no_difference():
    mapped = np.random.default_rng(0).uniform(0.2, 0.8, 500)
    assert brightness_correlation(*sums_of(mapped, 0.3 * mapped + 0.1)) == pytest.approx(1)


def test_one_color_is_like_nothing():
    mapped = np.random.default_rng(0).uniform(0.2, 0.8, 500)
    assert brightness_correlation(*sums_of(mapped, np.full(500, 0.35))) == pytest.approx(0, abs=1e-6)


def test_nothing_is_told_by_few_pixels_plain_surface_or_without_light():
    mapped = np.random.default_rng(0).uniform(0.2, 0.8, 500)
    assert math.isnan(brightness_correlation(*sums_of(mapped[: MIN_POINTS - 1], mapped[: MIN_POINTS - 1])))
    assert math.isnan(brightness_correlation(*sums_of(0.05 * mapped + 0.4, mapped)))
    assert math.isnan(brightness_correlation(*sums_of(mapped, 0.05 * mapped)))
    assert math.isnan(brightness_correlation(*sums_of(mapped, np.full(500, 0.99))))
    assert math.isnan(brightness_correlation(*[0.0] * 6))


@pytest.fixture(scope="module")
def dataset():
    return Recorded(12)


def mapped(dataset, device="cpu"):
    system = SlamSystem(settings(), dataset.camera, dataset.poses()[0], device)
    for i in range(10):
        system.process(dataset[i])
    return system


@pytest.fixture(scope="module")
def system(dataset):
    return mapped(dataset)


def likeness_of(system, frame, pose):
    records = sample_frame(frame, system.camera, system.config).records.to(system.device)
    return brightness_correlation(*brightness_sums(system.state.scene, records, pose, system.camera).tolist())


def test_a_frame_is_like_the_map_where_it_is_and_not_in_other_colors(dataset, device):
    system = mapped(dataset, device)
    frame, pose = dataset[9], system.state.frames.poses[9]
    assert likeness_of(system, frame, pose) > 0.7
    frame.color[:] = frame.color // 3 + 20
    assert likeness_of(system, frame, pose) > 0.7
    frame.color[:] = 90
    assert likeness_of(system, frame, pose) == pytest.approx(0, abs=1e-3)


def test_off_the_map_nothing_is_told(dataset, system):
    for pose in (torch.tensor([1.0, 0, 0, 0, 50, 50, 50]), torch.full((7,), math.nan)):
        assert math.isnan(likeness_of(system, dataset[9], pose))


def test_a_doubtful_frame_in_other_colors_is_doubted_more(dataset, system):
    """A start too far off makes the frame doubtful; it is laid right, but its colors are another place's."""
    start = system.state.frames.poses[9].clone()
    start[4:] += torch.tensor([3.0, 0.0, 0.0])
    found = []
    for color in (None, 90):
        frame = dataset[10]
        if color is not None:
            frame.color[:] = color
        pixels = sample_frame(frame, dataset.camera, system.config)
        found.append(system.localize(pixels, start, 10))
    alike, other = found
    assert alike.fit.brightness_correlation > 0.7
    assert other.fit.brightness_correlation == pytest.approx(0, abs=1e-3)
    assert other.error_probability > alike.error_probability
