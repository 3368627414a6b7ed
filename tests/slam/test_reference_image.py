"""The small gray image of a mapped frame, and tracking with it."""

import numpy as np
import pytest
import torch

from spslam.camera import Camera
from spslam.slam.frame_history import FrameHistory
from spslam.slam.pixels import sample_frame, unpack_points
from spslam.slam.reference_image import ReferenceCache, reference_cells
from spslam.slam.system import SlamSystem
from tests.system.sequences import Recorded, settings

CAMERA = Camera(160, 120, 100.0, 100.0, 79.5, 59.5)  # cells of 2 x 2 pixels


def record(u, v, depth, rgb):
    color = rgb[0] | rgb[1] << 8 | rgb[2] << 16
    return [u | v << 16, int(np.float32(depth).view(np.int32)), color]


def test_cells_are_means_of_their_records():
    records = torch.tensor(
        [record(0, 0, 1.0, (255, 255, 255)), record(1, 1, 2.0, (0, 0, 0)), record(159, 119, 3.0, (0, 255, 0))],
        dtype=torch.int32,
    )
    cells = reference_cells(records, CAMERA)
    assert cells.shape == (60, 80, 2)
    torch.testing.assert_close(cells[0, 0], torch.tensor([0.5, 1.5]))
    torch.testing.assert_close(cells[-1, -1], torch.tensor([0.587, 3.0]))
    assert cells[1:-1].count_nonzero() == 0


def test_a_reference_is_made_once_a_frame_and_follows_its_pose():
    cache = ReferenceCache(CAMERA, weight_m=0.3, kernel=0.4)
    records = torch.tensor([record(10, 10, 1.0, (9, 9, 9))], dtype=torch.int32)
    first, again = (cache.get(5, records, torch.full((7,), pose)) for pose in (1.0, 2.0))
    assert again.cells is first.cells and again.pose[0] == 2.0
    assert cache.get(10, records, first.pose).cells is not first.cells


@pytest.fixture(scope="module")
def dataset():
    return Recorded(12)


def processed(dataset, count, *overrides):
    system = SlamSystem(settings(*overrides), dataset.camera, dataset.poses()[0])
    for i in range(count):
        system.process(dataset[i])
    return system


def test_the_reference_is_the_last_mapped_frame(dataset):
    system = processed(dataset, 8, "mapping.every=3")
    history = FrameHistory(system.state)
    row, frame = history.last_mapped(every=3)
    assert row == 6 and torch.equal(frame.pose, system.state.frames.poses[6])
    system.state.frames.lost[6] = True
    assert history.last_mapped(every=3)[0] == 3
    system.state.frames.lost[:] = True
    assert history.last_mapped(every=3) is None


def test_colors_take_part_where_asked(dataset):
    """Color moves the pose a little."""
    plain, on = (
        processed(dataset, 8, *overrides).state.frames.poses for overrides in ((), ("tracking.color_weight_m=0.1",))
    )
    assert not torch.equal(plain, on)
    assert (on - plain).abs().max() < 0.01


def test_depth_of_cells_is_that_of_the_frame(dataset):
    pixels = sample_frame(dataset[0], dataset.camera, settings())
    cells = reference_cells(pixels.records, dataset.camera)
    known = cells[..., 1][cells[..., 1] > 0]
    z = unpack_points(pixels.records, dataset.camera)[:, 2]
    assert z.min() - 1e-3 < known.min() and known.max() < z.max() + 1e-3
