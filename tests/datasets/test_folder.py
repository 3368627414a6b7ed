import json
import shutil

import cv2
import numpy as np
import pytest

from spslam.camera import Camera
from spslam.datasets.folder import open_folder
from spslam.errors import DatasetError
from tests.datasets.layouts import (
    CAMERA_MATRIX,
    HEIGHT,
    WIDTH,
    depth_meters,
    matrix_text,
    poses,
    write_depth,
    write_folder,
)

CAMERA = Camera(WIDTH, HEIGHT, 30, 31, 15.5, 11.5)


def test_a_recording(tmp_path):
    dataset = open_folder(write_folder(tmp_path / "office", count=12))
    assert dataset.name == "folder/office"
    assert dataset.camera == CAMERA
    assert dataset.poses() is None
    assert len(dataset) == 12
    frame = dataset[10]  # 10.png sorts before 2.png by name
    np.testing.assert_allclose(frame.depth, depth_meters(10), atol=1e-6)
    assert frame.pose is None
    np.testing.assert_allclose(dataset.timestamps(), np.arange(12) / 30)


@pytest.mark.parametrize("name", ["rgb", "images"])
def test_other_names_of_the_color_folder(tmp_path, name):
    folder = write_folder(tmp_path)
    shutil.move(folder / "color", folder / name)
    assert len(open_folder(folder)) == 3


def test_pairing(tmp_path):
    folder = write_folder(tmp_path, count=3)
    (folder / "color" / ".hidden.jpg").touch()
    for i in range(3):
        (folder / "depth" / f"{i}.png").rename(folder / "depth" / f"{i}-d.png")
    assert open_folder(folder)[2].depth[0, 0] == pytest.approx(depth_meters(2)[0, 0], abs=1e-6)
    (folder / "depth" / "2-d.png").unlink()
    with pytest.raises(DatasetError, match="must have the same names or be as many, got 3 and 2"):
        open_folder(folder)


def test_a_frame_without_depth_is_a_broken_frame(tmp_path):
    folder = write_folder(tmp_path)
    (folder / "depth" / "1.png").unlink()
    dataset = open_folder(folder)
    assert len(dataset) == 3
    with pytest.raises(DatasetError, match=r"color/1.jpg: the depth image of this frame is missing"):
        dataset[1]
    assert dataset[2].depth.any()


def test_intrinsics_files(tmp_path):
    folder = write_folder(tmp_path)
    values = {"fx": 30, "fy": 31, "cx": 15.5, "cy": 11.5}
    padded = np.eye(4)
    padded[:3, :3] = CAMERA_MATRIX
    for name, text in (
        ("intrinsics.txt", matrix_text(padded)),
        ("camera-intrinsics.txt", "30, 31, 15.5, 11.5"),
        ("intrinsics.json", json.dumps(values)),
        ("camera.json", json.dumps({**values, "width": WIDTH, "height": HEIGHT, "depth_scale": 1000})),
    ):
        (folder / "intrinsics.txt").unlink(missing_ok=True)
        (folder / name).write_text(text)
        assert open_folder(folder).camera == CAMERA
        (folder / name).unlink()
    with pytest.raises(DatasetError, match="must contain the intrinsics in one of intrinsics.txt"):
        open_folder(folder)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"fx": "wide"}, "must contain numbers fx, fy, cx, cy, got fx: wide"),
        ({"fx": True}, "must contain numbers fx, fy, cx, cy, got fx: True"),
        ({"width": 640}, "width must be the images' 32, got 640"),
        ({"depth_scale": -1}, "depth_scale must be a number from 0.001 to 1e.09, got -1"),
        ({"fy": -5}, "Camera: fy must be positive, got -5"),
    ],
)
def test_wrong_json(tmp_path, change, message):
    folder = write_folder(tmp_path)
    (folder / "intrinsics.txt").unlink()
    (folder / "intrinsics.json").write_text(json.dumps({"fx": 30, "fy": 31, "cx": 15.5, "cy": 11.5, **change}))
    with pytest.raises(DatasetError, match=f"intrinsics.json: {message}"):
        open_folder(folder)


def test_depth_scale_comes_from_the_option_or_the_json(tmp_path):
    folder = write_folder(tmp_path, units_per_meter=5000)
    assert open_folder(folder, depth_scale=5000)[0].depth[0, 0] == pytest.approx(1, abs=1e-3)
    (folder / "intrinsics.txt").unlink()
    values = {"fx": 30, "fy": 31, "cx": 15.5, "cy": 11.5, "depth_scale": 5000}
    (folder / "intrinsics.json").write_text(json.dumps(values))
    assert open_folder(folder)[0].depth[0, 0] == pytest.approx(1, abs=1e-3)
    with pytest.raises(DatasetError, match="depth_scale must be a number from 0.001 to 1e.09, got 0"):
        open_folder(folder, depth_scale=0)


@pytest.mark.parametrize(
    ("scale", "message"),
    [
        (1, r"0.png: median depth must be within 0.1 and 20 m, got \d+ m with depth_scale 1; "),
        (65000, r"0.png: median depth must be within 0.1 and 20 m, got 0.02\d+ m with depth_scale 6.5e\+04; "),
    ],
)
def test_implausible_scales(tmp_path, scale, message):
    folder = write_folder(tmp_path)
    with pytest.raises(DatasetError, match=message + "depth_scale 1000 or 5000 would fit"):
        open_folder(folder, depth_scale=scale)


def test_plausibility_skips_empty_and_broken_images(tmp_path):
    folder = write_folder(tmp_path, count=4)
    write_depth(folder / "depth" / "0.png", np.zeros((HEIGHT, WIDTH)))
    (folder / "depth" / "1.png").write_bytes(b"")
    assert len(open_folder(folder)) == 4
    with pytest.raises(DatasetError, match="depth/2.png: median depth"):
        open_folder(folder, depth_scale=1.0)


def test_a_hand_before_the_lens_at_first_is_no_wrong_scale(tmp_path):
    folder = write_folder(tmp_path, count=12)
    for number in range(4):
        write_depth(folder / "depth" / f"{number}.png", np.full((HEIGHT, WIDTH), 0.06))
    assert len(open_folder(folder)) == 12


def test_floating_point_depth_is_in_meters(tmp_path):
    folder = write_folder(tmp_path, count=1)
    (folder / "depth" / "0.png").unlink()
    cv2.imwrite(str(folder / "depth" / "0.tiff"), depth_meters(0).astype(np.float32))
    np.testing.assert_allclose(open_folder(folder)[0].depth, depth_meters(0), atol=1e-6)


def test_poses_are_read_if_there(tmp_path):
    folder = write_folder(tmp_path, count=3)
    (folder / "poses.txt").write_text("".join(matrix_text(pose) for pose in poses(2)))
    dataset = open_folder(folder)
    np.testing.assert_allclose(dataset[1].pose, poses(2)[1], atol=1e-8)
    assert dataset[2].pose is None
    (folder / "poses.txt").write_text("".join(matrix_text(pose) for pose in poses(5)))
    assert dataset[1].pose is not None
    assert len(open_folder(folder).poses()) == 3


def test_wrong_layouts(tmp_path):
    with pytest.raises(DatasetError, match="must contain a folder color"):
        open_folder(tmp_path)
    (tmp_path / "color").mkdir()
    with pytest.raises(DatasetError, match=r"color: must contain images \(.png, .jpg, .jpeg\), got none"):
        open_folder(tmp_path)
    cv2.imwrite(str(tmp_path / "color" / "0.png"), np.zeros((4, 4, 3), np.uint8))
    with pytest.raises(DatasetError, match="depth: no such folder"):
        open_folder(tmp_path)
