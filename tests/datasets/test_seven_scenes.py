import statistics
import time

import cv2
import numpy as np
import pytest

from spslam.camera import Camera
from spslam.datasets.seven_scenes import list_sequences, open_seven_scenes
from spslam.errors import DatasetError
from tests.datasets.layouts import (
    color_image,
    depth_meters,
    matrix_text,
    poses,
    shared_data,
    truncate,
    write_color,
    write_depth,
    write_seven_scenes,
)


def test_a_scene(tmp_path):
    dataset = open_seven_scenes(write_seven_scenes(tmp_path / "kitchen"))
    assert dataset.name == "7scenes/kitchen/seq-01"
    assert len(dataset) == 4
    assert dataset.camera == Camera(32, 24, 30, 31, 15.5, 11.5)
    frame = dataset[2]
    np.testing.assert_array_equal(frame.color, color_image(2))
    np.testing.assert_allclose(frame.depth, depth_meters(2), atol=1e-6)
    np.testing.assert_allclose(frame.pose, poses(4)[2], atol=1e-9)
    assert (frame.index, frame.timestamp) == (2, pytest.approx(2 / 30))
    np.testing.assert_allclose(dataset.poses(), poses(4), atol=1e-9)
    np.testing.assert_allclose(dataset.timestamps(), np.arange(4) / 30)


def test_a_sequence_folder_directly_takes_the_scene_s_intrinsics(tmp_path):
    scene = write_seven_scenes(tmp_path)
    assert open_seven_scenes(scene / "seq-01").camera.fx == 30
    assert not open_seven_scenes(scene / "seq-01").doubts
    (scene / "camera-intrinsics.txt").unlink()
    guessed = open_seven_scenes(scene / "seq-01")
    assert guessed.camera == Camera(640, 480, 585, 585, 320, 240).resized(32, 24)
    assert [doubt.kind for doubt in guessed.doubts] == ["default camera"]  # the data set's images are 640x480


def test_sequences(tmp_path):
    scene = write_seven_scenes(tmp_path, count=1, sequences=("seq-02", "seq-11"))
    (scene / "TestSplit.txt").write_text("sequence11\n")
    (scene / "TrainSplit.txt").write_text("sequence2\nsequence 3\n")
    assert open_seven_scenes(scene).name.endswith("seq-02")
    for wanted in ("seq-11", "11", 11):
        assert open_seven_scenes(scene, wanted).name.endswith("seq-11")
    assert list_sequences(scene) == ["seq-02", "seq-11"]
    assert list_sequences(scene, "test") == ["seq-11"]
    assert list_sequences(scene, "train") == ["seq-02", "seq-03"]
    with pytest.raises(DatasetError, match="sequence must be one of seq-02, seq-11, got 5"):
        open_seven_scenes(scene, 5)


def test_the_first_sequence_of_a_split(tmp_path):
    scene = write_seven_scenes(tmp_path, count=1, sequences=("seq-01", "seq-02", "seq-03"))
    (scene / "TestSplit.txt").write_text("sequence3\n")
    (scene / "TrainSplit.txt").write_text("sequence2\nsequence1\n")
    assert open_seven_scenes(scene, "test").name.endswith("seq-03")
    assert open_seven_scenes(scene, "train").name.endswith("seq-01")
    (scene / "TestSplit.txt").unlink()
    with pytest.raises(DatasetError, match="TestSplit.txt: no such file"):
        open_seven_scenes(scene, "test")


def test_packed_sequences_are_pointed_out(tmp_path):
    (tmp_path / "seq-02.zip").touch()
    (tmp_path / "seq-01.zip").touch()
    with pytest.raises(DatasetError, match="got none; unpack seq-01.zip and its like first"):
        open_seven_scenes(tmp_path)


def test_rotations_are_projected_to_so3(tmp_path):
    scene = write_seven_scenes(tmp_path, count=1)
    pose = np.eye(4)
    pose[0, 0], pose[0, 1] = 1.002, 0.001
    (scene / "seq-01" / "frame-000000.pose.txt").write_text("\n".join(" ".join(map(str, row)) for row in pose))
    rotation = open_seven_scenes(scene)[0].pose[:3, :3]
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)


def test_invalid_depth_values(tmp_path):
    scene = write_seven_scenes(tmp_path, count=1)
    depth = np.full((24, 32), 1.5)
    depth[0, 0], depth[0, 1] = 65.535, 0
    write_depth(scene / "seq-01" / "frame-000000.depth.png", depth)
    assert open_seven_scenes(scene)[0].depth[0, :3].tolist() == [0, 0, 1.5]


def test_poses_are_optional(tmp_path):
    scene = write_seven_scenes(tmp_path, count=3)
    (scene / "seq-01" / "frame-000001.pose.txt").unlink()
    (scene / "seq-01" / "frame-000002.pose.txt").write_text("nan " * 16)
    dataset = open_seven_scenes(scene)
    assert [frame.pose is None for frame in dataset] == [False, True, True]
    assert np.isnan(dataset.poses()[1:]).all()
    (scene / "seq-01" / "frame-000000.pose.txt").unlink()
    assert open_seven_scenes(scene).poses() is None


def test_numbers_may_have_gaps(tmp_path):
    scene = write_seven_scenes(tmp_path, count=4)
    for kind in ("color.png", "depth.png", "pose.txt"):
        (scene / "seq-01" / f"frame-000001.{kind}").unlink()
    dataset = open_seven_scenes(scene)
    np.testing.assert_allclose(dataset.timestamps(), [0, 2 / 30, 3 / 30])
    np.testing.assert_allclose(dataset[1].pose, poses(4)[2], atol=1e-9)


def test_numbers_may_have_any_count_of_digits(tmp_path):
    scene = write_seven_scenes(tmp_path, count=4)
    for path in list((scene / "seq-01").iterdir()):
        path.rename(path.with_name(path.name.replace("frame-0000", "frame-")))
    np.testing.assert_allclose(open_seven_scenes(scene).poses(), poses(4), atol=1e-9)


def test_broken_frames_name_their_file_and_leave_the_others(tmp_path):
    scene = write_seven_scenes(tmp_path, count=8)
    sequence = scene / "seq-01"
    truncate(sequence / "frame-000000.color.png")
    (sequence / "frame-000001.depth.png").unlink()
    (sequence / "frame-000002.color.png").unlink()
    (sequence / "frame-000003.depth.png").write_bytes(b"")
    (sequence / "frame-000004.pose.txt").write_text("1 0 0\n")
    (sequence / "frame-000005.pose.txt").write_text("two " * 16)
    write_depth(sequence / "frame-000006.depth.png", np.ones((12, 16)))
    dataset = open_seven_scenes(scene)
    for index, message in enumerate(
        [
            "frame-000000.color.png: the image is truncated",
            "frame-000001.color.png: the depth image of this frame is missing",
            "frame-000002.depth.png: the color image of this frame is missing",
            "frame-000003.depth.png: the file is empty",
        ]
    ):
        with pytest.raises(DatasetError, match=message) as error:
            dataset[index]
        assert "\n" not in str(error.value)
    with pytest.raises(
        DatasetError, match="frame-000006.depth.png: must be as large as the sequence's first image, 32x24, got 16x12"
    ):
        dataset[6]
    assert [dataset[index].pose is None for index in (4, 5, 7)] == [True, True, False]
    (doubt,) = dataset.doubts
    assert "frame-000004.pose.txt: a pose must have 16 numbers, got 3 (and 1 more such poses)" in str(doubt)
    assert np.isfinite(dataset.poses()).all(axis=(1, 2)).tolist() == [True] * 4 + [False] * 2 + [True] * 2


def test_frames_of_another_size_than_the_first(tmp_path):
    scene = write_seven_scenes(tmp_path, count=2)
    write_color(scene / "seq-01" / "frame-000001.color.png", np.zeros((10, 12, 3), np.uint8))
    write_depth(scene / "seq-01" / "frame-000001.depth.png", np.ones((10, 12)))
    with pytest.raises(
        DatasetError, match="frame-000001.*must be as large as the sequence's first image, 32x24, got 12x10"
    ):
        open_seven_scenes(scene)[1]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("1 2 3", "intrinsics must be a 3x3 or 4x4 matrix or fx fy cx cy, got 3 numbers"),
        ("1 0 x 0 1 2 0 0 1", "must contain numbers only"),
        ("0 0 5 0 9 5 0 0 1", "Camera: fx must be positive, got 0"),
        ("585 0 320 0 585 240 0 0 1", r"principal point must lie in the image of 32x24, got \(320, 240\)"),
        ("1 2 3 4 5 6 7 8 9", "matrix must have the form"),
    ],
)
def test_wrong_intrinsics(tmp_path, text, message):
    scene = write_seven_scenes(tmp_path, count=1)
    (scene / "camera-intrinsics.txt").write_text(text)
    with pytest.raises(DatasetError, match=rf"camera-intrinsics.txt: .*{message}"):
        open_seven_scenes(scene)


def test_wrong_folders(tmp_path):
    with pytest.raises(DatasetError, match="nowhere: no such folder"):
        open_seven_scenes(tmp_path / "nowhere")
    (tmp_path / "file").touch()
    with pytest.raises(DatasetError, match="file: must be a folder, got a file"):
        open_seven_scenes(tmp_path / "file")
    with pytest.raises(DatasetError, match="must contain 7-Scenes frames .* got none"):
        open_seven_scenes(tmp_path)
    with pytest.raises(DatasetError, match="must contain seq-02, got no seq-XX folder"):
        open_seven_scenes(tmp_path, 2)


def test_a_png_and_a_jpg_of_one_frame_are_ambiguous(tmp_path):
    scene = write_seven_scenes(tmp_path, count=1)
    write_color(scene / "seq-01" / "frame-000000.color.jpg", color_image(0))
    with pytest.raises(DatasetError, match="must be the only file of frame 0"):
        open_seven_scenes(scene)


def write_kinects(scene, size=(64, 48)):
    """A frame of the dataset's own camera: a wall at 2 m, and a square before it at 1 m."""
    width, height = size
    sequence = scene / "seq-01"
    color = np.zeros((height, width, 3), np.uint8)
    color[..., 0] = np.arange(width) * 255 // width
    color[..., 1] = np.arange(height)[:, None] * 255 // height
    depth = np.full((height, width), 2.0)
    depth[height // 3 : 2 * height // 3, width // 3 : 2 * width // 3] = 1
    write_color(sequence / "frame-000000.color.png", color)
    write_depth(sequence / "frame-000000.depth.png", depth)
    (sequence / "frame-000000.pose.txt").write_text(matrix_text(np.eye(4)))
    return color, depth


def test_color_of_the_kinect_comes_to_its_depth(tmp_path):
    color, depth = write_kinects(tmp_path, (640, 480))
    dataset = open_seven_scenes(tmp_path)
    assert dataset.is_registered
    assert dataset.camera == Camera(640, 480, 585, 585, 320, 240)
    assert not dataset.doubts
    frame = dataset[0]
    np.testing.assert_array_equal(frame.pose, np.eye(4))
    kept = frame.depth > 0
    np.testing.assert_allclose(frame.depth[kept], depth[kept], atol=1e-6)
    # The color camera sees more than the depth camera, so only what the square hides is missing: 525 2.6 cm (1 - 1/2)
    # pixels wide, to one side of it.
    assert 0 < np.mean(~kept) < 0.01
    # The middle of the image, by hand: turned by 0.008 to either side and 2.6 cm beside, at 525 px and 1 m.
    u, v = 320 + 525 * (-0.0079041 - 0.0255589), 240 + 525 * (-0.0081505 + 0.0001011)
    np.testing.assert_allclose(frame.color[240, 320, :2], (u * 255 / 640, v * 255 / 480), atol=1)
    for path in tmp_path.rglob("*.color.*"):
        path.unlink()
    np.testing.assert_array_equal(dataset.depth(0), frame.depth)  # for which no color image is read


def test_color_may_be_left_as_it_is(tmp_path):
    color, depth = write_kinects(tmp_path)
    dataset = open_seven_scenes(tmp_path, registered=True)
    assert not dataset.is_registered  # it is not said to be, nor asked for by the checks of the data
    np.testing.assert_array_equal(dataset[0].color, color)
    np.testing.assert_allclose(dataset[0].depth, depth, atol=1e-6)
    assert (open_seven_scenes(tmp_path)[0].color != color).any()


def test_recordings_of_other_cameras_are_left_as_they_are(tmp_path):
    scene = write_seven_scenes(tmp_path)
    assert open_seven_scenes(scene).registration is None
    assert open_seven_scenes(scene, registered=False).registration is not None


def test_the_kitchen():
    dataset = open_seven_scenes(shared_data("7scenes-redkitchen"))
    assert len(dataset) >= 300
    assert dataset.camera == Camera(640, 480, 585, 585, 320, 240)
    assert np.isfinite(dataset.poses()).all()
    frame = dataset[100]
    assert frame.color.shape == (480, 640, 3)
    assert 0.5 < np.median(frame.depth[frame.depth > 0]) < 4
    assert frame.depth.max() < 20


def least_seconds(function, *arguments, times=5):
    """Time of this thread alone and the best of some calls, because other processes share the machine."""
    seconds = []
    for _ in range(times):
        started = time.thread_time()
        function(*arguments)
        seconds.append(time.thread_time() - started)
    return min(seconds)


def decode(files):
    cv2.imread(str(files.color))
    cv2.imread(str(files.depth), cv2.IMREAD_UNCHANGED)


def test_reading_costs_little_more_than_decoding():
    dataset = open_seven_scenes(shared_data("7scenes-redkitchen"), registered=True)
    ours, decoding = (
        statistics.median(least_seconds(function, i) for i in range(0, 50, 5))
        for function in (dataset.__getitem__, lambda index: decode(dataset.frames[index]))
    )
    # Some 0.6 ms more than 4.6 ms, most of it for fresh memory; as a ratio, because both grow on a busy machine.
    assert ours < 1.5 * decoding


def test_registering_a_frame_costs_little():
    dataset = open_seven_scenes(shared_data("7scenes-redkitchen"), registered=True)
    registration = open_seven_scenes(shared_data("7scenes-redkitchen")).registration
    frame = dataset[100]

    def decode_and_copy():
        decode(dataset.frames[100])
        return frame.color.copy(), frame.depth.copy()  # fresh memory, as what is registered takes

    registering = least_seconds(registration, frame.color, frame.depth, times=20)
    # Some 0.25 of it with AVX-512 and 0.4 to 0.65 on slow cores with AVX2; 0.9 in NumPy (4.5 of 4.9 ms). A ratio,
    # because both grow on a slow or busy machine.
    assert registering < 0.85 * least_seconds(decode_and_copy, times=20)
