"""ScanNet scans as its exporter leaves them."""

import shutil

import numpy as np
import pytest

from spslam.camera import Camera
from spslam.config import load_config
from spslam.datasets import open_dataset
from spslam.datasets.scannet import SensDataset, open_scannet
from spslam.errors import DatasetError
from tests.datasets.layouts import (
    HEIGHT,
    WIDTH,
    color_image,
    depth_meters,
    poses,
    truncate,
    write_scannet,
    write_sens,
)


def test_a_scan(tmp_path):
    dataset = open_scannet(write_scannet(tmp_path / "scene0059_00", count=12))
    assert (dataset.name, len(dataset)) == ("scannet/scene0059_00", 12)
    assert dataset.camera == Camera(WIDTH, HEIGHT, 30, 31, 15.5, 11.5)
    found = dataset[10]  # 10 sorts before 2 by name
    assert found.color.shape == (HEIGHT, WIDTH, 3)
    # JPEG's own error, away from the edge.
    assert np.abs(found.color.astype(int) - color_image(10))[:, :8].max() < 10
    np.testing.assert_allclose(found.depth, depth_meters(10), atol=1e-6)
    np.testing.assert_allclose(dataset.poses(), poses(12), atol=1e-9)
    np.testing.assert_allclose(dataset.timestamps(), np.arange(12) / 30)


def test_where_a_scan_may_be(tmp_path):
    scan = write_scannet(tmp_path / "scene")
    inner = tmp_path / "other" / "frames"
    shutil.copytree(scan, inner)
    assert len(open_scannet(inner.parent)) == 4
    assert open_scannet(inner.parent).name == "scannet/other"
    write_sens(scan / "scene.sens", count=2)
    assert len(open_scannet(scan)) == 4
    shutil.rmtree(scan / "color")
    assert isinstance(open_scannet(scan), SensDataset)
    write_sens(scan / "second.sens")
    with pytest.raises(DatasetError, match="must contain one .sens file, .* got scene.sens, second.sens"):
        open_scannet(scan)
    with pytest.raises(DatasetError, match="must contain one .sens file, .* got neither"):
        open_scannet(tmp_path)
    with pytest.raises(DatasetError, match="nowhere: no such folder"):
        open_scannet(tmp_path / "nowhere")


def test_intrinsics(tmp_path):
    scan = write_scannet(tmp_path)
    (scan / "intrinsic" / "intrinsic_depth.txt").unlink()
    # Those of color, which is twice as large, with pixel centers at whole numbers.
    expected = Camera(2 * WIDTH, 2 * HEIGHT, 60, 62, 31, 23).resized(WIDTH, HEIGHT)
    assert open_scannet(scan).camera == expected
    shutil.rmtree(scan / "intrinsic")
    with pytest.raises(DatasetError, match="intrinsic_depth.txt: no such file; it must contain depth's intrinsics"):
        open_scannet(scan)
    (scan / "intrinsic_depth.txt").write_text("30 31 15 11")
    assert open_scannet(scan).camera == Camera(WIDTH, HEIGHT, 30, 31, 15, 11)


def test_broken_frames_name_their_file_and_leave_the_others(tmp_path):
    scan = write_scannet(tmp_path, count=8)
    truncate(scan / "depth" / "0.png")
    (scan / "depth" / "1.png").unlink()
    (scan / "color" / "2.jpg").write_bytes(b"")
    (scan / "pose" / "3.txt").write_text("-inf " * 16)
    (scan / "pose" / "4.txt").unlink()
    (scan / "pose" / "5.txt").write_text("1 2 3")
    (scan / "pose" / "6.txt").write_text(" ".join(["nan"] * 16))
    dataset = open_scannet(scan)
    for index, message in {
        0: "depth/0.png: the image is truncated",
        1: "color/1.jpg: the depth image of this frame is missing",
        2: "color/2.jpg: the file is empty",
    }.items():
        with pytest.raises(DatasetError, match=message):
            dataset[index]
    assert [dataset[index].pose is None for index in (3, 4, 5, 6, 7)] == [True, True, True, True, False]
    assert "pose/5.txt: a pose must have 16 numbers, got 3: these frames count as" in str(dataset.doubts[0])
    shutil.rmtree(scan / "pose")
    assert open_scannet(scan).poses() is None


def test_numbers_may_have_any_count_of_digits(tmp_path):
    scan = write_scannet(tmp_path, count=12)
    for folder in ("color", "depth", "pose"):
        for path in list((scan / folder).iterdir()):
            path.rename(path.with_stem(f"{int(path.stem):06d}"))
    dataset = open_scannet(scan)
    np.testing.assert_allclose(dataset.poses(), poses(12), atol=1e-9)
    assert not dataset.doubts


def test_a_scan_without_images(tmp_path):
    scan = write_scannet(tmp_path, count=1)
    (scan / "depth" / "0.png").unlink()
    with pytest.raises(DatasetError, match="depth: must contain a ScanNet scan's images .* got none"):
        open_scannet(scan)


def test_the_shipped_configuration_clears_the_border(tmp_path):
    scan = write_scannet(tmp_path, count=1)
    config = load_config("scannet", overrides=["dataset.min_depth_m=0.5"])
    depth = open_dataset(config.dataset, scan)[0].depth
    inside = np.zeros_like(depth, dtype=bool)
    inside[10:-10, 10:-10] = True
    np.testing.assert_array_equal(depth > 0, inside)


def test_the_paper_s_iterations():
    config = load_config("scannet", "paper")
    assert (config.tracking.iterations, config.mapping.iterations) == (6, 20)
