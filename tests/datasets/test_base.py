import numpy as np
import pytest

from spslam.camera import Camera
from spslam.datasets.base import RgbdDataset, RgbdFrame, Subset
from spslam.errors import DatasetError


class Ramp(RgbdDataset):
    """Ten frames whose depth is their number in meters."""

    name = "ramp"
    camera = Camera(4, 3, 4, 4, 1.5, 1)

    def __init__(self, with_poses: bool = True) -> None:
        self._with_poses = with_poses

    def __len__(self):
        return 10

    def timestamps(self):
        return np.arange(10) / 10

    def poses(self):
        return np.arange(10)[:, None, None] * np.eye(4) if self._with_poses else None

    def read(self, index):
        return RgbdFrame(index, index / 10, np.zeros((3, 4, 3), np.uint8), np.full((3, 4), index, np.float32))


def test_index_range_and_iteration():
    dataset = Ramp()
    assert dataset[np.int64(3)].index == 3
    assert [frame.index for frame in dataset] == list(range(10))
    for index in (-1, 10):
        with pytest.raises(IndexError, match=rf"ramp: frame must be in 0\.\.9, got {index}"):
            dataset[index]
    with pytest.raises(TypeError):
        dataset[1.0]


def test_depth_range_is_inclusive():
    dataset = Ramp()
    dataset.depth_range = (2.0, 5.0)
    assert [float(frame.depth.max()) for frame in dataset] == [0, 0, 2, 3, 4, 5, 0, 0, 0, 0]


def test_depth_alone_is_the_frames():
    dataset = Subset(Ramp(), 1, None, 2)
    dataset.depth_range, dataset.border_px = (2.0, 7.0), 1
    for index, frame in enumerate(dataset):
        np.testing.assert_array_equal(dataset.depth(index), frame.depth)
    with pytest.raises(IndexError, match=r"ramp: frame must be in 0\.\.4, got 5"):
        dataset.depth(5)
    dataset.read_depth = lambda index: np.zeros((2, 4), np.float32)
    with pytest.raises(DatasetError, match="as large as the sequence's first, 4x3, got 4x2"):
        dataset.depth(1)


def test_sizes_are_checked():
    dataset = Ramp()
    dataset.read = lambda index: RgbdFrame(index, 0, np.zeros((3, 4, 3), np.uint8), np.zeros((2, 4), np.float32))
    with pytest.raises(
        DatasetError, match="ramp, frame 1: depth must be as large as color, got depth 4x2 and color 4x3"
    ):
        dataset[1]
    dataset.read = lambda index: RgbdFrame(index, 0, np.zeros((2, 4, 3), np.uint8), np.zeros((2, 4), np.float32))
    with pytest.raises(DatasetError, match="as large as the sequence's first, 4x3, got 4x2"):
        dataset[1]


@pytest.mark.parametrize(
    ("bounds", "expected"),
    [((), range(10)), ((2, 5), range(2, 5)), ((1, None, 4), range(1, 10, 4)), ((-3,), range(7, 10)), ((8, 99), [8, 9])],
)
def test_subset(bounds, expected):
    subset = Subset(Ramp(), *bounds)
    assert len(subset) == len(expected)
    assert [float(frame.depth[0, 0]) for frame in subset] == list(expected)
    assert [frame.index for frame in subset] == list(range(len(expected)))
    np.testing.assert_allclose(subset.timestamps(), np.array(expected) / 10)
    np.testing.assert_allclose(subset.poses()[:, 0, 0], list(expected))


def test_subset_keeps_the_depth_range_and_unknown_poses():
    dataset = Ramp(with_poses=False)
    dataset.depth_range = (0, 4.5)
    subset = Subset(Subset(dataset, 2), 1, None, 2)
    assert [float(frame.depth[0, 0]) for frame in subset] == [3, 0, 0, 0]
    assert subset.poses() is None


def test_subset_errors():
    with pytest.raises(DatasetError, match=r"ramp: frames must select at least one of 0\.\.9, got 10:20:1"):
        Subset(Ramp(), 10, 20)
    with pytest.raises(DatasetError, match="got 5:5:1"):
        Subset(Ramp(), 5, 5)
    with pytest.raises(ValueError, match="Subset: step must be at least 1, got 0"):
        Subset(Ramp(), step=0)
