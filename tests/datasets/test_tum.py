import re

import cv2
import numpy as np
import pytest

from spslam.camera import Camera
from spslam.datasets.inspection import inspect_dataset
from spslam.datasets.pairing import associate, interpolate_trajectory
from spslam.datasets.tum import open_tum
from spslam.errors import DatasetError
from spslam.geometry import interpolate_pose
from spslam.trajectory import Trajectory
from tests.datasets.layouts import (
    HEIGHT,
    WIDTH,
    color_image,
    depth_meters,
    poses,
    shared_data,
    write_color,
    write_depth,
    write_tum,
)


def test_a_sequence(tmp_path):
    dataset = open_tum(write_tum(tmp_path / "desk"))
    assert dataset.name == "tum/desk"
    assert len(dataset) == 5
    assert dataset.camera == Camera(640, 480, 525, 525, 319.5, 239.5).resized(WIDTH, HEIGHT)
    frame = dataset[1]
    np.testing.assert_array_equal(frame.color, color_image(1))
    np.testing.assert_allclose(frame.depth, depth_meters(1), atol=1.1e-4)
    assert frame.timestamp == pytest.approx(1000 + 1 / 30, abs=1e-6)
    # The truth's poses are 10 ms apart and begin 50 ms before the first frame.
    expected = interpolate_pose(poses(40)[8], poses(40)[9], 1 / 3)
    np.testing.assert_allclose(frame.pose, expected, atol=1e-4)
    np.testing.assert_array_equal(dataset.poses()[1], frame.pose)


def test_when_images_were_taken(tmp_path):
    dataset = open_tum(write_tum(tmp_path, count=12, depth_delay=0.006))
    for i in (0, 5, 11):
        offsets = dataset[i].offsets
        assert offsets.depth == pytest.approx(0.006, abs=1e-5)
        assert offsets.color == pytest.approx(-0.006, abs=1e-5)


def test_cameras_by_folder_name(tmp_path):
    for name, focal in (
        ("rgbd_dataset_freiburg1_desk", 517.3),
        ("rgbd_dataset_freiburg2_xyz", 520.9),
        ("fr3-office", 535.4),
        ("fr12", 525.0),
    ):
        dataset = open_tum(write_tum(tmp_path / name, count=1))
        assert dataset.camera.fx == pytest.approx(focal * WIDTH / 640)
        assert (dataset.undistortion is None) == (focal in (535.4, 525.0))


def test_both_images_are_undistorted(tmp_path):
    folder = write_tum(tmp_path / "freiburg1_x", count=1)
    color = cv2.GaussianBlur(np.random.default_rng(0).integers(0, 255, (120, 160, 3), dtype=np.uint8), (0, 0), 2)
    rows, columns = np.mgrid[:120, :160]
    depth = 2 + np.sin(rows / 30) * np.cos(columns / 35) / 4
    write_color(next((folder / "rgb").iterdir()), color)
    write_depth(next((folder / "depth").iterdir()), depth, 5000.0)
    dataset = open_tum(folder)
    distortion = np.array([0.2624, -0.9531, -0.0054, 0.0026, 1.1633])
    expected = cv2.undistort(color, dataset.camera.matrix(), distortion)
    inside = np.s_[10:-10, 10:-10]
    assert np.abs(dataset[0].color.astype(int) - expected)[inside].max() <= 2  # fixed-point weights
    assert np.abs(dataset[0].color.astype(int) - color)[inside].max() > 20
    expected = cv2.undistort(depth, dataset.camera.matrix(), distortion)
    np.testing.assert_allclose(dataset[0].depth[inside], expected[inside], atol=2e-3)
    assert np.abs(dataset[0].depth - depth)[inside].max() > 0.01


def test_a_calibration_file_comes_first(tmp_path):
    folder = write_tum(tmp_path / "freiburg1_x", count=1)
    (folder / "calibration.txt").write_text("30 31 15 11\n")
    dataset = open_tum(folder)
    assert dataset.camera == Camera(WIDTH, HEIGHT, 30, 31, 15, 11)
    assert dataset.undistortion is None
    (folder / "calibration.txt").write_text("30 31 15 11 0.1 0.01\n")
    assert open_tum(folder).undistortion is not None
    (folder / "calibration.txt").write_text("30 31 15\n")
    with pytest.raises(DatasetError, match="calibration.txt: must contain fx fy cx cy"):
        open_tum(folder)


def test_unsorted_and_duplicate_lines(tmp_path):
    folder = write_tum(tmp_path)
    expected = open_tum(folder).timestamps()
    for name in ("rgb.txt", "depth.txt", "groundtruth.txt"):
        lines = (folder / name).read_text().splitlines()
        (folder / name).write_text("\n".join([*reversed(lines), lines[2]]))
    dataset = open_tum(folder)
    np.testing.assert_array_equal(dataset.timestamps(), expected)
    assert np.isfinite(dataset.poses()).all()


def test_images_without_a_partner_in_time_are_left_out(tmp_path):
    folder = write_tum(tmp_path, count=5)
    lines = (folder / "depth.txt").read_text().splitlines()
    (folder / "depth.txt").write_text("\n".join(lines[:2] + lines[3:]))
    dataset = open_tum(folder)
    np.testing.assert_allclose(dataset.timestamps(), 1000 + np.array([0, 2, 3, 4]) / 30, atol=1e-6)
    with pytest.raises(DatasetError, match=r"within 0.02 s of each other, got none \(5 in rgb.txt, 5 in depth.txt\)"):
        open_tum(write_tum(tmp_path / "late", depth_delay=5.0))


def test_truth_is_optional_and_nothing_is_made_up(tmp_path):
    folder = write_tum(tmp_path, count=12)
    lines = (folder / "groundtruth.txt").read_text().splitlines()
    # Poses 10 to 29 go: a gap from 999.95 + 0.09 to 999.95 + 0.30; the last is at 1000.34.
    (folder / "groundtruth.txt").write_text("\n".join(lines[:11] + lines[31:]))
    known = [frame.pose is not None for frame in open_tum(folder)]
    assert known == [True, True, False, False, False, False, False, False, True, True, True, False]
    (folder / "groundtruth.txt").unlink()
    assert open_tum(folder).poses() is None


def shifted(lines, seconds):
    for line in lines:
        time, rest = line.split(" ", 1)
        yield f"{float(time) + seconds:.4f} {rest}"


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda lines: [], "groundtruth.txt holds no pose; write poses, or remove it"),
        (
            lambda lines: shifted(lines, 500),
            r"groundtruth.txt covers 1499.95 to 1500.34 s, the frames 1000 to",
        ),
        (lambda lines: shifted(lines, -500), r"groundtruth.txt covers 499.95 to 500.34 s, the frames 1000 to"),
        (
            lambda lines: lines[3::20],
            r"groundtruth.txt are 0.2 s apart, and none is interpolated between poses over",
        ),
        (lambda lines: lines[2:3] + lines[35:36], r"groundtruth.txt are 0.33 s apart"),
    ],
)
def test_truth_that_covers_no_frame_is_a_doubt(tmp_path, change, words):
    folder = write_tum(tmp_path / "fr1", count=4)
    lines = (folder / "groundtruth.txt").read_text().splitlines()[1:]
    (folder / "groundtruth.txt").write_text("\n".join(change(lines)))
    dataset = open_tum(folder)
    assert dataset.poses() is None
    (doubt,) = dataset.doubts
    assert re.search(words, str(doubt)), str(doubt)


def test_a_camera_that_is_guessed_is_a_doubt(tmp_path):
    folder = write_tum(tmp_path / "mine")
    (doubt,) = open_tum(folder).doubts
    assert "ROS is taken, with a focal length of 525 px at 640x480" in str(doubt)
    assert "write calibration.txt with fx fy cx cy" in str(doubt)
    (folder / "calibration.txt").write_text("30 31 15 11\n")
    assert open_tum(folder).doubts == ()
    (folder / "calibration.txt").unlink()
    (tmp_path / "freiburg2_mine").symlink_to(folder)
    linked = open_tum(tmp_path / "freiburg2_mine")
    assert linked.doubts == ()
    assert linked.camera.fx == pytest.approx(520.9 * WIDTH / 640)
    assert open_tum(write_tum(tmp_path / "fr3")).doubts == ()


def test_how_many_color_images_have_no_depth_is_said(tmp_path):
    folder = write_tum(tmp_path / "fr1", count=20)
    assert open_tum(folder).remarks == ()
    lines = (folder / "depth.txt").read_text().splitlines()
    (folder / "depth.txt").write_text("\n".join([lines[0], *lines[1::2]]))
    expected = "depth: 10 of 20 color images have no depth image within 0.02 s"
    assert open_tum(folder).remarks == (expected,)
    assert inspect_dataset(open_tum(folder)).problems[-1] == expected
    (folder / "depth.txt").write_text("\n".join(lines[:-1]))
    assert open_tum(folder).remarks == ()  # as happens in any recording


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("rgb.txt", "# nothing\n", "rgb.txt: must list at least one image, got none"),
        ("depth.txt", "1000.0\n", "depth.txt, line 1: must have 2 columns, got '1000.0'"),
        ("rgb.txt", "noon rgb/1.png\n", "rgb.txt: must list `timestamp file`, got 'noon rgb/1.png'"),
        ("rgb.txt", "nan rgb/1.png\n", "rgb.txt: timestamps must be finite, got nan"),
        ("groundtruth.txt", "1 2 3\n", "groundtruth.txt, line 1: must be `timestamp tx"),
    ],
)
def test_broken_lists(tmp_path, name, text, message):
    folder = write_tum(tmp_path)
    (folder / name).write_text(text)
    with pytest.raises(DatasetError, match=message):
        open_tum(folder)


def test_missing_files(tmp_path):
    folder = write_tum(tmp_path)
    next((folder / "depth").iterdir()).unlink()
    errors = 0
    dataset = open_tum(folder)
    for index in range(len(dataset)):
        try:
            dataset[index]
        except DatasetError as error:
            assert "no such file" in str(error)
            errors += 1
    assert errors == 1
    (folder / "depth.txt").unlink()
    with pytest.raises(DatasetError, match="depth.txt: no such file"):
        open_tum(folder)


def test_associate_takes_the_closest_pairs_first():
    a, b = np.array([0.0, 1.0, 2.0]), np.array([0.9, 1.02, 2.3])
    assert associate(a, b, 0.5).tolist() == [[1, 1], [2, 2]]
    assert associate(a, b, 0.95).tolist() == [[0, 0], [1, 1], [2, 2]]
    assert associate(a, np.zeros(0), 1.0).shape == (0, 2)


def test_interpolation_at_and_beyond_the_ends():
    trajectory = Trajectory([0.0, 1.0, 2.0], poses(3))
    found = interpolate_trajectory(trajectory, np.array([-0.1, 0.0, 0.5, 2.0, 2.1]), max_gap=1.5)
    assert np.isfinite(found).all(axis=(1, 2)).tolist() == [False, True, True, True, False]
    np.testing.assert_allclose(found[[1, 3]], poses(3)[[0, 2]], atol=1e-12)
    exact = interpolate_trajectory(trajectory, np.array([0.5, 1.0]), max_gap=0.5)
    assert np.isfinite(exact).all(axis=(1, 2)).tolist() == [False, True]
    assert np.isnan(interpolate_trajectory(Trajectory([], []), np.zeros(2), 1.0)).all()
    single = interpolate_trajectory(Trajectory([1.0], poses(1)), np.array([0.5, 1.0, 1.5]), 1.0)
    assert np.isfinite(single).all(axis=(1, 2)).tolist() == [False, True, False]


def test_freiburg1_rpy():
    dataset = open_tum(shared_data("tum-fr1-rpy-60"))
    assert 55 <= len(dataset) <= 60
    assert dataset.camera.fx == 517.3
    assert np.isfinite(dataset.poses()).all()
    frame = dataset[3]
    assert frame.color.shape == (480, 640, 3)
    assert 0.5 < np.median(frame.depth[frame.depth > 0]) < 4
