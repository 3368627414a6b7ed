import shutil

import numpy as np
import pytest

from spslam.camera import Camera
from spslam.datasets.synthetic_rgbd import open_synthetic_rgbd
from spslam.errors import DatasetError
from tests.datasets.layouts import color_image, depth_meters, poses, shared_data, write_depth, write_synthetic_rgbd


def test_a_scene(tmp_path):
    dataset = open_synthetic_rgbd(write_synthetic_rgbd(tmp_path / "room"))
    assert dataset.name == "synthetic_rgbd/room"
    assert dataset.camera == Camera(32, 24, 30, 30, 15.5, 11.5)
    assert len(dataset) == 12
    frame = dataset[10]  # img10 sorts before img2 by name
    np.testing.assert_array_equal(frame.color, color_image(10))
    np.testing.assert_allclose(frame.depth, depth_meters(10) + 0.1, atol=1e-6)
    np.testing.assert_allclose(frame.pose, poses(12)[10], atol=1e-8)
    np.testing.assert_allclose(dataset.poses(), poses(12), atol=1e-8)


def test_depth_variants(tmp_path):
    scene = write_synthetic_rgbd(tmp_path, count=2)
    np.testing.assert_allclose(open_synthetic_rgbd(scene, "exact")[1].depth, depth_meters(1), atol=1e-6)
    shutil.rmtree(scene / "depth_filtered")
    np.testing.assert_allclose(open_synthetic_rgbd(scene)[1].depth, depth_meters(1), atol=1e-6)
    with pytest.raises(DatasetError, match=r"depth_filtered: no such folder; there is depth \(depth_variant: exact\)"):
        open_synthetic_rgbd(scene, "filtered")
    with pytest.raises(DatasetError, match="depth_variant must be one of filtered, noisy, exact, got best"):
        open_synthetic_rgbd(scene, "best")


def test_poses_with_nan_missing_and_absent(tmp_path):
    scene = write_synthetic_rgbd(tmp_path, count=4)
    lines = (scene / "poses.txt").read_text().splitlines()
    lines[4] = "nan nan nan nan"
    (scene / "poses.txt").write_text("\n".join(lines[:12]))
    dataset = open_synthetic_rgbd(scene)
    assert [frame.pose is None for frame in dataset] == [False, True, False, True]
    (scene / "poses.txt").unlink()
    assert open_synthetic_rgbd(scene).poses() is None


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("focal.txt", "", "focal.txt: must contain one number, the focal length in pixels, got 0"),
        ("focal.txt", "-3", "focal.txt: Camera: fx must be positive, got -3"),
        ("poses.txt", "1 0 0 0\n", r"poses.txt: must have 16 numbers per pose .*, got 1 lines of 4"),
        ("poses.txt", "oops", "poses.txt: must contain numbers only"),
    ],
)
def test_broken_text_files(tmp_path, name, text, message):
    scene = write_synthetic_rgbd(tmp_path, count=1)
    (scene / name).write_text(text)
    with pytest.raises(DatasetError, match=message):
        open_synthetic_rgbd(scene)


def test_a_pose_that_is_no_motion_is_unknown(tmp_path):
    scene = write_synthetic_rgbd(tmp_path, count=2)
    (scene / "poses.txt").write_text("2 0 0 0 0 2 0 0 0 0 2 0 0 0 0 1\n" + "1 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1\n")
    dataset = open_synthetic_rgbd(scene)
    assert "poses.txt, pose 0: must be a rotation and a translation" in str(dataset.doubts[0])
    assert [frame.pose is None for frame in dataset] == [True, False]


def test_noisy_depth_is_a_variant(tmp_path):
    scene = write_synthetic_rgbd(tmp_path, count=1)
    with pytest.raises(DatasetError, match="depth_with_noise: no such folder; there is depth_filtered"):
        open_synthetic_rgbd(scene, "noisy")
    write_depth(scene / "depth_with_noise" / "depth0.png", depth_meters(0) + 0.2)
    np.testing.assert_allclose(open_synthetic_rgbd(scene, "noisy")[0].depth, depth_meters(0) + 0.2, atol=1e-6)


def test_wrong_layouts(tmp_path):
    scene = write_synthetic_rgbd(tmp_path, count=1)
    (scene / "focal.txt").unlink()
    with pytest.raises(DatasetError, match="focal.txt: no such file"):
        open_synthetic_rgbd(scene)
    shutil.rmtree(scene / "images")
    with pytest.raises(DatasetError, match="must contain images/img0.png"):
        open_synthetic_rgbd(scene)
    with pytest.raises(DatasetError, match="must contain a folder depth_filtered or depth, got neither"):
        open_synthetic_rgbd(tmp_path.parent)


def test_exact_depth_of_the_gray_room_agrees_between_views():
    dataset = open_synthetic_rgbd(shared_data("synthetic-grey-white-room"), "exact")
    assert len(dataset) == 400
    first, second = dataset[0], dataset[8]
    points = dataset.camera.unproject(first.depth)[::8, ::8].reshape(-1, 3)
    moved = np.linalg.inv(second.pose) @ first.pose @ np.c_[points, np.ones(len(points))].T
    pixels = np.round(dataset.camera.project(moved[:3].T))
    inside = np.isfinite(pixels).all(1) & (pixels >= 0).all(1) & (pixels < (640, 480)).all(1)
    columns, rows = pixels[inside].astype(int).T
    # Half a pixel on slanted surfaces and the 1 mm of storage.
    assert np.median(np.abs(second.depth[rows, columns] - moved[2, inside])) < 0.005
