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
    color_image,
    depth_meters,
    matrix_text,
    poses,
    write_color,
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


@pytest.mark.parametrize("distortion", [{}, {"k1": 0.01}])
def test_the_largest_number_is_not_measured(tmp_path, distortion):
    recording = write_folder(tmp_path, units_per_meter=10000)
    values = {"fx": 30.0, "fy": 31.0, "cx": 15.5, "cy": 11.5, "depth_scale": 10000} | distortion
    (recording / "intrinsics.txt").unlink()
    (recording / "intrinsics.json").write_text(json.dumps(values))
    for path in (recording / "depth").iterdir():
        stored = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
        stored[:, :20] = 65535  # most of it: the median, too, must not be that of these
        assert cv2.imwrite(str(path), stored)
    depth = open_folder(recording)[0].depth
    assert not depth[:, :16].any()
    assert 1 < depth[12, 28] < 2.6
    assert depth.max() < 2.6


def test_floating_point_depth_is_in_meters(tmp_path):
    folder = write_folder(tmp_path, count=1)
    (folder / "depth" / "0.png").unlink()
    cv2.imwrite(str(folder / "depth" / "0.tiff"), depth_meters(0).astype(np.float32))
    np.testing.assert_allclose(open_folder(folder)[0].depth, depth_meters(0), atol=1e-6)


def test_poses_are_read_if_there(tmp_path):
    folder = write_folder(tmp_path, count=3)
    unknown = np.full((4, 4), np.nan)
    (folder / "poses.txt").write_text("".join(matrix_text(pose) for pose in (*poses(2), unknown)))
    dataset = open_folder(folder)
    np.testing.assert_allclose(dataset[1].pose, poses(2)[1], atol=1e-8)
    assert dataset[2].pose is None
    for row_size in (12, 16):
        rows = (" ".join(f"{value:.9e}" for value in pose.ravel()[:row_size]) for pose in poses(3))
        (folder / "poses.txt").write_text("\n".join(rows))
        np.testing.assert_allclose(open_folder(folder).poses(), poses(3), atol=1e-8)


@pytest.mark.parametrize("count", [2, 4])
def test_another_count_of_poses_than_of_frames_is_refused(tmp_path, count):
    folder = write_folder(tmp_path, count=3)
    (folder / "poses.txt").write_text("".join(matrix_text(pose) for pose in poses(count)))
    with pytest.raises(DatasetError, match=f"poses.txt: must have one pose for each of 3 frames, got {count}; 16 time"):
        open_folder(folder)


def test_the_pose_of_a_frame_that_a_kill_interrupted_is_left_out(tmp_path):
    folder = write_folder(tmp_path, count=3)
    for image in folder.glob("*/*"):
        image.rename(image.with_stem(f"{int(image.stem):06d}"))
    (folder / "times.txt").write_text("0\n0.1\n")
    for count in (2, 3):
        (folder / "poses.txt").write_text("".join(matrix_text(pose) for pose in poses(count)))
        np.testing.assert_allclose(open_folder(folder).poses(), poses(2), atol=1e-8)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("# time tx ty tz qx qy qz qw\n0 1 2 3 0 0 0 1\n1 1 2 3 0 0 0 1\n", "got 8 numbers in line 2"),
        ("1 0 0 0 0 1 0 0 0 0 1 0 0 0 0 1\n1 0 0 0 0 1 0\n", "got 7 numbers in line 2"),
        ("1 0 0 0\n0 1 0 0\n0 0 1 0\n0 0 0 1\n1 0 0 0\n", "got 5 lines of 4 numbers"),
        ("1 0 0 0 0 1 0 0 0 0 1 0\n1 0 0 0\n", "got 4 numbers in line 2"),
    ],
)
def test_poses_in_other_columns_are_refused(tmp_path, text, words):
    folder = write_folder(tmp_path, count=1)
    (folder / "poses.txt").write_text(text)
    with pytest.raises(DatasetError, match=f"poses.txt: must have 16 numbers per pose .*{words}"):
        open_folder(folder)


def test_files_that_contradict_each_other_are_refused(tmp_path):
    folder = write_folder(tmp_path)
    values = {"fx": 30, "fy": 31, "cx": 15.5, "cy": 11.5, "depth_scale": 5000}
    (folder / "intrinsics.json").write_text(json.dumps(values))
    with pytest.raises(DatasetError, match="the intrinsics in one file, got intrinsics.txt and intrinsics.json; remov"):
        open_folder(folder)
    (folder / "intrinsics.json").unlink()
    shutil.copy(folder / "intrinsics.txt", folder / "camera-intrinsics.txt")  # says the same
    assert len(open_folder(folder)) == 3
    (folder / "rgb").mkdir()
    assert len(open_folder(folder)) == 3
    shutil.copy(folder / "color" / "0.jpg", folder / "rgb" / "0.jpg")
    with pytest.raises(DatasetError, match="must contain one folder of color images, got color and rgb; rename or mov"):
        open_folder(folder)
    shutil.rmtree(folder / "rgb")
    write_color(folder / "color" / "1.png", color_image(1))
    with pytest.raises(DatasetError, match=r"color/1.png: must be the only image of its name, got 1.jpg as well"):
        open_folder(folder)


@pytest.mark.parametrize("kind", ["color", "depth"])
def test_one_odd_image_is_named_and_not_the_intrinsics(tmp_path, kind):
    folder = write_folder(tmp_path, count=4)
    (folder / "intrinsics.txt").unlink()
    values = {"fx": 30, "fy": 31, "cx": 15.5, "cy": 11.5, "width": WIDTH, "height": HEIGHT}
    (folder / "intrinsics.json").write_text(json.dumps(values))
    if kind == "color":
        write_color(folder / "color" / "0.jpg", color_image(0)[::2, ::2])
    else:
        write_depth(folder / "depth" / "0.png", depth_meters(0)[::2, ::2])
    dataset = open_folder(folder)
    assert dataset.camera == CAMERA
    with pytest.raises(DatasetError, match=rf"{kind}/0.\w+: must be as large as most images .*, 32x24, got 16x12"):
        dataset[0]
    assert dataset[3].depth.any()


def test_wrong_layouts(tmp_path):
    with pytest.raises(DatasetError, match="must contain a folder color"):
        open_folder(tmp_path)
    (tmp_path / "color").mkdir()
    with pytest.raises(DatasetError, match=r"color: must contain images \(.png, .jpg, .jpeg\), got none"):
        open_folder(tmp_path)
    cv2.imwrite(str(tmp_path / "color" / "0.png"), np.zeros((4, 4, 3), np.uint8))
    with pytest.raises(DatasetError, match="depth: no such folder"):
        open_folder(tmp_path)
