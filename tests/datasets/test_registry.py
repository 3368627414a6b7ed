from types import SimpleNamespace

import numpy as np
import pytest

from spslam.config import load_config
from spslam.datasets import dataset_types, open_dataset, open_sequence, sequence_options
from spslam.datasets.base import Subset
from spslam.errors import DatasetError
from spslam.options import DATASET_TYPES
from tests.datasets.layouts import (
    depth_meters,
    write_folder,
    write_replica,
    write_scannet,
    write_seven_scenes,
    write_synthetic_rgbd,
    write_tum,
)

WRITERS = {
    "7scenes": write_seven_scenes,
    "synthetic_rgbd": write_synthetic_rgbd,
    "replica": write_replica,
    "tum": write_tum,
    "scannet": write_scannet,
    "folder": write_folder,
}


@pytest.mark.parametrize("kind", WRITERS)
def test_every_format_gives_the_same_frames(tmp_path, kind):
    folder = WRITERS[kind](tmp_path / "data")
    dataset = open_dataset(SimpleNamespace(type=kind, depth_variant="exact"), folder)
    assert len(dataset.timestamps()) == len(dataset) >= 3
    assert (np.diff(dataset.timestamps()) > 0).all()
    for index, frame in enumerate(dataset):
        assert frame.index == index
        assert frame.timestamp == dataset.timestamps()[index]
        assert frame.color.dtype == np.uint8
        assert frame.depth.dtype == np.float32
        assert frame.color.flags.c_contiguous
        np.testing.assert_allclose(frame.depth, depth_meters(index), atol=2e-4)
        np.testing.assert_array_equal(dataset.depth(index), frame.depth)


def test_generated_needs_no_folder():
    config = SimpleNamespace(type="generated", path=None, frames=3, width=48, height=32, noise=None, seed=7)
    dataset = open_dataset(config)
    assert (len(dataset), dataset.camera.width) == (3, 48)
    assert dataset[0].depth.shape == (32, 48)


def test_common_options(tmp_path):
    folder = write_seven_scenes(tmp_path, count=5, sequences=("seq-01", "seq-02"))
    config = SimpleNamespace(type="7scenes", path=folder, stride=2, min_depth_m=1.2, max_depth_m=2.0, sequence="seq-02")
    dataset = open_dataset(config)
    assert isinstance(dataset, Subset)
    assert dataset.name.endswith("seq-02")
    assert len(dataset) == 3
    depth = dataset[1].depth
    expected = depth_meters(2)
    np.testing.assert_allclose(depth, np.where((expected >= 1.2) & (expected <= 2.0), expected, 0), atol=1e-6)


def test_the_argument_overrides_the_path(tmp_path):
    folder = write_folder(tmp_path / "data")
    assert len(open_dataset(SimpleNamespace(type="folder", path="elsewhere"), str(folder))) == 3


def test_one_section_of_options_a_sequence(tmp_path):
    scene = write_seven_scenes(tmp_path / "scene", count=1, sequences=("seq-01", "seq-02"))
    (scene / "TestSplit.txt").write_text("sequence2\n")

    def sequences(*overrides):
        options = load_config("7scenes", overrides=[("dataset.path", str(scene)), *overrides]).dataset
        return [found.sequence for found in sequence_options(options)]

    assert sequences() == ["seq-01", "seq-02"]
    assert sequences("dataset.sequence=test") == ["seq-02"]
    assert sequences("dataset.sequence=1") == [1]
    assert sequences(("dataset.path", str(scene / "seq-01"))) == [None]
    assert sequences("dataset.type=tum") == [None]
    assert sequences(("dataset.path", None)) == [None]
    with pytest.raises(DatasetError, match="TrainSplit.txt: no such file"):
        sequences("dataset.sequence=train")


def test_errors():
    files = ["7scenes", "synthetic_rgbd", "tum", "replica", "scannet", "folder", "rosbag", "realsense", "azure_kinect"]
    files += ["stray_scanner", "record3d", "scannetpp", "arkitscenes", "open3d", "video", "bonn", "icl_nuim"]
    assert dataset_types() == [*files, "generated", "places"]
    assert set(dataset_types()) == set(DATASET_TYPES)
    with pytest.raises(DatasetError, match="dataset.type must be one of 7scenes, .*, generated, places, got kitti"):
        open_dataset(SimpleNamespace(type="kitti"))
    with pytest.raises(DatasetError, match="dataset.path must name the folder of the tum data"):
        open_dataset(SimpleNamespace(type="tum"))
    with pytest.raises(DatasetError, match="nowhere: no such folder"):
        open_dataset(SimpleNamespace(type="tum"), "nowhere")


def test_sequence_is_the_part_asked_for(tmp_path):
    write_seven_scenes(tmp_path / "scene", count=6)
    config = SimpleNamespace(type="7scenes")
    assert len(open_sequence(config, tmp_path / "scene")) == 6
    assert len(open_sequence(config, tmp_path / "scene", slice(1, None, 2))) == 3
    with pytest.raises(DatasetError, match="frames must select at least one of 0..5, got 6:9:1"):
        open_sequence(config, tmp_path / "scene", slice(6, 9))


def test_sequence_may_begin_with_a_broken_frame_but_not_be_broken_throughout(tmp_path):
    write_seven_scenes(tmp_path / "scene", count=2)
    config = SimpleNamespace(type="7scenes")
    first, second = sorted((tmp_path / "scene" / "seq-01").glob("*.depth.png"))
    first.write_bytes(b"")
    assert len(open_sequence(config, tmp_path / "scene")) == 2
    second.write_bytes(b"")
    with pytest.raises(DatasetError, match="no frame can be read; the first: .*frame-000000.depth.png"):
        open_sequence(config, tmp_path / "scene")
