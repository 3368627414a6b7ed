"""A frame's brightness against earlier frames': which say yes, which no, and which nothing."""

import math

import numpy as np
import pytest
import torch

from spslam.geometry import inverse, pose7_to_matrix
from spslam.slam.pixels import sample_frame, unpack_points
from spslam.slam.recovery.appearance import CELLS, MIN_POINTS, POINTS, brightness_correlation, brightness_sums
from spslam.slam.system import SlamSystem
from tests.system.sequences import Recorded, settings


def sums_of(stored, seen):
    columns = stored - stored.mean(), seen - seen.mean()
    squares = [float((a * b).sum()) for a, b in ((columns[0],) * 2, (columns[1],) * 2, columns)]
    return [float(len(stored)), float(seen.sum()), *squares]


def test_likeness_is_the_correlation():
    random = np.random.default_rng(0)
    stored = random.uniform(0.2, 0.8, 500)
    seen = 0.5 * stored + random.normal(0, 0.05, 500)
    assert brightness_correlation(*sums_of(stored, seen)) == pytest.approx(np.corrcoef(stored, seen)[0, 1])
    assert brightness_correlation(*sums_of(stored, 1 - seen)) == pytest.approx(-np.corrcoef(stored, seen)[0, 1])


def test_exposure_makes_no_difference():
    stored = np.random.default_rng(0).uniform(0.2, 0.8, 500)
    assert brightness_correlation(*sums_of(stored, 0.3 * stored + 0.1)) == pytest.approx(1)


def test_one_color_is_like_nothing():
    stored = np.random.default_rng(0).uniform(0.2, 0.8, 500)
    assert brightness_correlation(*sums_of(stored, np.full(500, 0.35))) == pytest.approx(0, abs=1e-6)


def test_nothing_is_told_by_few_pixels_plain_surface_or_without_light():
    stored = np.random.default_rng(0).uniform(0.2, 0.8, 500)
    assert math.isnan(brightness_correlation(*sums_of(stored[: MIN_POINTS - 1], stored[: MIN_POINTS - 1])))
    assert math.isnan(brightness_correlation(*sums_of(0.05 * stored + 0.4, stored)))
    assert math.isnan(brightness_correlation(*sums_of(stored, 0.05 * stored)))
    assert math.isnan(brightness_correlation(*sums_of(stored, np.full(500, 0.99))))
    assert math.isnan(brightness_correlation(*[0.0] * 5))


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


def sums_at(system, frame, pose, rows=(3, 6)):
    pixels = sample_frame(frame, system.camera, system.config).to(system.device)
    history, rows = system.history, torch.tensor(rows, dtype=torch.int64, device=system.device)
    depth_m = system.config.dataset.max_depth_m
    return brightness_sums(pixels, pose, history.records, history.poses, rows, system.camera, depth_m).tolist()


def likeness_of(system, frame, pose):
    return brightness_correlation(*sums_at(system, frame, pose))


def test_sums_are_those_of_points_that_the_frame_sees(dataset, system):
    """Point by point, with NumPy, at whole pixels of the image."""
    frame, pose = dataset[9], system.state.frames.poses[9]
    camera, expected = system.camera, []  # pairs of brightness, by cell of the earlier image
    gray = frame.color @ np.array([0.299, 0.587, 0.114]) / 255
    for row in (3, 6):
        records, earlier = system.history.records[row, :POINTS], system.history.poses[row]
        to_frame = inverse(pose7_to_matrix(pose.numpy().astype(float))) @ pose7_to_matrix(earlier.numpy().astype(float))
        colors = [[(word >> shift) & 255 for shift in (0, 8, 16)] for word in records[:, 2].tolist()]
        pairs = {}
        pixels = [(word & 0xFFFF, word >> 16) for word in records[:, 0].tolist()]
        points = unpack_points(records, camera).double().numpy()
        for point, color, (column, line) in zip(points, colors, pixels, strict=True):
            cell = (column * CELLS // camera.width, line * CELLS // camera.height)
            x, y, z = to_frame[:3, :3] @ point + to_frame[:3, 3]
            u, v = x / z * camera.fx + camera.cx, y / z * camera.fy + camera.cy
            if z > 0.05 and 0 <= u < camera.width - 1 and 0 <= v < camera.height - 1:
                depth = frame.depth[int(v + 0.5), int(u + 0.5)]
                if abs(depth - z) < 0.05 * z:
                    pair = np.dot(color, (0.299, 0.587, 0.114)) / 255, gray[int(v + 0.5), int(u + 0.5)]
                    pairs.setdefault(cell, []).append(pair)
        expected += map(np.array, pairs.values())
    found = sums_at(system, frame, pose)
    assert found[0] == pytest.approx(sum(map(len, expected)), rel=0.01)
    assert found[1] == pytest.approx(sum(pairs[:, 1].sum() for pairs in expected), rel=0.02)
    squared = sum(((pairs[:, 0] - pairs[:, 0].mean()) ** 2).sum() for pairs in expected)
    assert found[2] == pytest.approx(squared, rel=0.02)
    # The nearest pixel is not the value between pixels.
    both = sum(np.cov(pairs.T, bias=True)[0, 1] * len(pairs) for pairs in expected)
    assert found[4] == pytest.approx(both, rel=0.1)


def test_a_frame_is_like_those_of_its_place_and_not_in_other_colors(dataset, device):
    system = mapped(dataset, device)
    frame, pose = dataset[9], system.state.frames.poses[9]
    assert likeness_of(system, frame, pose) > 0.8
    frame.color[:] = frame.color // 3 + 20
    assert likeness_of(system, frame, pose) > 0.8
    frame.color[:] = 90
    assert likeness_of(system, frame, pose) == pytest.approx(0, abs=1e-3)


def test_where_no_frame_has_been_nothing_is_told(dataset, system):
    for pose in (torch.tensor([1.0, 0, 0, 0, 50, 50, 50]), torch.full((7,), math.nan)):
        assert math.isnan(likeness_of(system, dataset[9], pose))
    assert sums_at(system, dataset[9], system.state.frames.poses[9], rows=()) == [0.0] * 5


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
