"""Every format of recordings gives the frames that were written, is found out by its path, and names what is wrong."""

import json
import pickle
import re
import shutil
from pathlib import Path

import numpy as np
import pytest

from spslam.config import load_config
from spslam.datasets import identify_recording, open_dataset
from spslam.datasets.clock import AT_ONCE
from spslam.datasets.lens import Lens
from spslam.datasets.prefetch import prefetch
from spslam.errors import DatasetError
from spslam.geometry import inverse
from tests.datasets import recordings as write
from tests.datasets.cameras import extrinsics, path, render
from tests.datasets.layouts import (
    color_image,
    depth_meters,
    matrix_text,
    poses,
    truncate,
    write_folder,
    write_replica,
    write_scannet,
    write_seven_scenes,
    write_synthetic_rgbd,
    write_tum,
)

pytest.importorskip("av")
COUNT = 5
# Of each format: the configuration, its writer, the time of the second frame, and whether color is stored with losses.
FORMATS = {
    "stray_scanner": ("stray_scanner", write.write_stray_scanner, write.START_S + 1 / 60),
    "r3d": ("record3d", write.write_record3d, write.START_S + 1 / 60),
    "r3d folder": ("record3d", write.write_record3d_folder, write.START_S + 1 / 60),
    "r3d export": ("record3d", write.write_record3d_export, write.START_S + 1 / 60),
    "scannetpp": ("scannetpp", write.write_scannetpp, write.START_S + 1 / 60),
    "arkitscenes": ("arkitscenes", write.write_arkitscenes, write.START_S + 0.1),
    "open3d": ("open3d", write.write_open3d, 1 / 30),
    "icl_nuim": ("icl_nuim", write.write_icl_nuim, 1 / 30),
    "video": ("video", write.write_video_recording, 1 / 30),
}


def open_path(recording, *overrides):
    found = identify_recording(recording)
    return open_dataset(load_config(found.config, overrides=[("dataset.path", str(recording)), *overrides]).dataset)


@pytest.mark.parametrize("name", FORMATS)
def test_a_recording_is_found_out_and_gives_its_frames(tmp_path, name):
    config, writer, second = FORMATS[name]
    recording = writer(tmp_path / "mine", COUNT)
    assert identify_recording(recording).config == config
    confident = config in ("stray_scanner", "record3d", "arkitscenes")
    dataset = open_path(recording, *(["dataset.min_confidence=0"] if confident else []))
    assert len(dataset) == COUNT
    assert dataset.timestamps()[1] == pytest.approx(second, abs=1e-4)
    assert (dataset.camera.width, dataset.camera.height) == (32, 24)
    if config != "icl_nuim":  # whose camera is known
        assert (dataset.camera.fx, dataset.camera.fy, dataset.camera.cx) == pytest.approx((30, 31, 15.5))
    with prefetch(pickle.loads(pickle.dumps(dataset)), workers=2) as frames:
        for i, frame in enumerate(frames):
            assert frame.index == i
            if config in ("stray_scanner", "scannetpp"):  # whose videos have a clock of their own
                assert frame.offsets == AT_ONCE
            np.testing.assert_allclose(frame.depth, depth_meters(i), atol=2e-4)
            away_from_the_edge = np.r_[1:14, 18:31]
            difference = frame.color.astype(int) - color_image(i)
            assert np.abs(difference[1:-1, away_from_the_edge]).max() <= 12
            np.testing.assert_allclose(frame.pose, poses(COUNT)[i], atol=1e-6)
            np.testing.assert_array_equal(dataset.depth(i), frame.depth)


@pytest.mark.parametrize("name", ["stray_scanner", "r3d", "arkitscenes"])
def test_depth_of_low_confidence_is_missing(tmp_path, name):
    config, writer, _ = FORMATS[name]
    recording = writer(tmp_path / "mine", 2)
    for least, expected in ((0, 24 * 32), (1, 24 * 29 + 4 * 3), (2, 20 * 29)):
        depth = open_path(recording, f"dataset.min_confidence={least}")[1].depth
        if least == 1:  # the upper rows were written before the left columns
            expected = 24 * 29
        assert (depth > 0).sum() == expected
    assert load_config(config).dataset.min_confidence == 1


@pytest.mark.parametrize("name", ["stray_scanner", "scannetpp", "arkitscenes"])
def test_depth_may_be_brought_to_the_color_image(tmp_path, name):
    dataset = open_path(FORMATS[name][1](tmp_path / "mine", 2), "dataset.register_to=color")
    frame = dataset[1]
    np.testing.assert_array_equal(dataset.depth(1), frame.depth)
    assert frame.depth.shape == (96, 128)
    assert frame.color.shape == (96, 128, 3)
    assert np.median(frame.depth[frame.depth > 0]) == pytest.approx(np.median(depth_meters(1)), abs=0.03)


@pytest.mark.parametrize("compression", ["lz4", "zlib"])
def test_scannetpp_as_downloaded(tmp_path, compression):
    dataset = open_path(write.write_scannetpp_packed(tmp_path / "scene", COUNT, compression))
    assert (dataset.camera.width, dataset.camera.height) == (256, 192)
    for i in (3, 0, 4):
        assert dataset[i].depth[100, 100] == pytest.approx(depth_meters(i)[12, 12], abs=1e-3)
        np.testing.assert_allclose(dataset[i].pose, poses(COUNT)[i], atol=1e-9)


def test_bonn_poses_are_the_cameras(tmp_path):
    recording = write.write_bonn(tmp_path / "rgbd_bonn_balloon", COUNT)
    assert identify_recording(recording).config == "bonn"
    dataset = open_path(recording)
    tum = open_dataset(load_config("tum", overrides=[("dataset.path", str(recording))]).dataset)
    np.testing.assert_allclose(dataset[1].depth, tum[1].depth)
    # Seen from the first camera, motion is the markers' seen from theirs, carried over by a fixed transform.
    moved, marked = (inverse(poses[0]) @ poses[2] for poses in (dataset.poses(), tum.poses()))
    assert np.trace(moved[:3, :3]) == pytest.approx(np.trace(marked[:3, :3]))
    assert not np.allclose(moved, marked, atol=1e-3)
    (recording / "calibration.txt").unlink()
    assert open_path(recording).camera.fx == pytest.approx(542.822841 / 20)


def test_redwoods_names_and_its_camera(tmp_path):
    recording = write.write_open3d(tmp_path / "lounge", COUNT)
    (recording / "intrinsic.json").unlink()
    (recording / "trajectory.log").rename(tmp_path / "lounge_trajectory.log")
    for kind in ("color", "depth"):
        for file in sorted((recording / kind).iterdir()):
            number = int(file.stem)
            late = 33_369 * number + (500 if kind == "depth" else 0)
            file.rename(file.with_name(f"{number + 1:07d}-{late:012d}{file.suffix}"))
    dataset = open_path(recording, "dataset.depth_scale=5000")
    assert dataset.camera.fx == 525 / 20
    assert not dataset.doubts  # Redwood's recordings are PrimeSense's
    assert dataset.timestamps()[1] == pytest.approx(0.033869)
    assert dataset[1].offsets.color == pytest.approx(-0.0005)
    np.testing.assert_allclose(dataset.poses(), poses(COUNT), atol=1e-8)
    np.testing.assert_allclose(dataset[2].depth, depth_meters(2), atol=2e-4)


def test_a_camera_of_open3d_that_is_guessed_is_a_doubt(tmp_path):
    recording = write.write_open3d(tmp_path / "mine", COUNT)
    assert not open_path(recording).doubts
    (recording / "intrinsic.json").unlink()
    (doubt,) = open_path(recording, "dataset.depth_scale=5000").doubts
    assert str(doubt).startswith("the camera is not known: there are no intrinsics, so that PrimeSense's is taken")


def test_a_pose_of_open3d_that_is_no_motion_is_unknown(tmp_path):
    recording = write.write_open3d(tmp_path / "mine", COUNT)
    lines = (recording / "trajectory.log").read_text().splitlines()
    lines[6] = "9 9 9 9"  # of the second pose
    (recording / "trajectory.log").write_text("\n".join(lines))
    dataset = open_path(recording)
    assert [frame.pose is None for frame in dataset] == [False, True, False, False, False]
    assert "trajectory.log, pose 1: must be a rotation and a translation" in str(dataset.doubts[0])
    shutil.copy(min((recording / "color").iterdir()), recording / "color" / "0.png")
    with pytest.raises(DatasetError, match="must be the only image of its number, got .* as well; remove one"):
        open_path(recording)


def test_a_video_is_paired_by_time_where_counts_differ(tmp_path):
    recording = write.write_video_recording(tmp_path / "mine", 6)
    for number in (0, 3):
        (recording / "depth" / f"{number}.png").unlink()
    with pytest.raises(
        DatasetError, match="as many frames as there are depth images, got 6 and 4; times.txt, with one"
    ):
        open_path(recording)
    (recording / "times.txt").write_text("\n".join(str(i / 30 + 0.004) for i in (1, 2, 4, 5)))
    with pytest.raises(DatasetError, match="poses.txt: must have one pose for each of 4 frames, got 6"):
        open_path(recording)
    (recording / "poses.txt").write_text("".join(matrix_text(poses(6)[i]) for i in (1, 2, 4, 5)))
    dataset = open_path(recording)
    assert len(dataset) == 4
    np.testing.assert_allclose(dataset[2].depth, depth_meters(4), atol=1e-6)
    assert dataset[2].color[5, 5, 2] == pytest.approx(4, abs=4)
    with pytest.raises(DatasetError, match="must have color and depth images within 0.001 s of each other, got none"):
        open_path(recording, "dataset.pair_tolerance_s=0.001")


@pytest.fixture(scope="module")
def kinect(tmp_path_factory):
    """Frames of the narrow mode (320x288) beside color of 1280x720, rendered through both lenses."""
    from spslam.datasets.azure_kinect import read_calibration

    place = extrinsics((0.03, -0.002, 0.004), (0.1, 0.002, 0.001))
    stored = write.azure_kinect_calibration(place)
    sizes = {"color": (1280, 720), "depth": (320, 288)}
    calibration = read_calibration(json.dumps(stored).encode(), sizes, "attachment")
    pose = path(60)[50]
    color = [render(calibration.color, pose)[0]] * 3
    depth = [render(calibration.depth, pose @ place)[1]] * 3
    folder = tmp_path_factory.mktemp("kinect")
    return write.write_azure_kinect(folder / "a.mkv", color, depth, stored), calibration, pose @ place, color, depth


def test_azure_kinect(kinect):
    recording, calibration, pose, _, _ = kinect
    assert calibration.color_from_depth[0, 3] == pytest.approx(0.03)
    assert calibration.depth.camera.cx == pytest.approx(0.5 * 512 - 96 - 0.5)
    assert calibration.color.camera.cy == pytest.approx(0.51 * 960 - 120 - 0.5)
    dataset = open_path(recording)
    frame = dataset[2]
    color, depth = render(Lens(calibration.depth.camera), pose)
    known = frame.depth > 0
    assert known.mean() > 0.6
    assert np.median(np.abs(frame.depth - depth)[known]) < 1e-3
    assert np.median(np.abs(frame.color.astype(int) - color)[known]) <= 5


def test_azure_kinect_without_its_tracks_or_calibration(tmp_path, kinect):
    _, _, _, color, depth = kinect
    with pytest.raises(DatasetError, match="must have the attachment calibration.json of k4arecorder, got none"):
        open_path(write.write_azure_kinect(tmp_path / "a.mkv", color, depth, None))
    plain = write.write_video(tmp_path / "b.mkv", [color_image(i) for i in range(3)])
    with pytest.raises(
        DatasetError, match="must have tracks COLOR and DEPTH of k4arecorder, got no COLOR and no DEPTH"
    ):
        open_path(plain)
    small = write.write_azure_kinect(tmp_path / "c.mkv", color, [d[::2, ::2] for d in depth], {})
    with pytest.raises(DatasetError, match="must describe a depth and a color camera, got neither"):
        open_path(small)


def remove(*names):
    def spoil(folder):
        for name in names:
            for found in list(folder.glob(name)):
                shutil.rmtree(found) if found.is_dir() else found.unlink()

    return spoil


def put(name, text):
    return lambda folder: next(iter(folder.glob(name))).write_text(text)


def cut(name):
    return lambda folder: truncate(next(iter(folder.glob(name))))


def odometry(*rows):
    return "\n".join(["timestamp, frame, x, y, z, qx, qy, qz, qw", *(f"{row}, 0, 0, 0, 0, 0, 0, 1" for row in rows)])


BROKEN = [
    ("stray_scanner", put("odometry.csv", "timestamp, frame\n1, 2\n"), "odometry.csv: must have a column qw, got"),
    ("stray_scanner", put("odometry.csv", "x, y\n1, up\n"), "odometry.csv: must contain numbers below its first line"),
    ("stray_scanner", put("odometry.csv", "x, y\n1, 2, 3\n"), "odometry.csv: rows must have 2 columns as the first"),
    ("stray_scanner", put("odometry.csv", ""), "odometry.csv: must have a line of names and rows of numbers"),
    (
        "stray_scanner",
        put("odometry.csv", odometry("1, 0", "nan, 1")),
        "odometry.csv: timestamps must be finite and as",
    ),
    ("stray_scanner", put("odometry.csv", odometry("1, nan", "2, 1e300")), "odometry.csv: must have frames of rgb.mp4"),
    ("stray_scanner", put("camera_matrix.csv", "1e308 0 16 0 30 12 0 0 1"), "focal lengths must be from 0.1 to 1e.06"),
    ("stray_scanner", put("camera_matrix.csv", "30 0 16 0 1e-9 12 0 0 1"), "focal lengths must be from 0.1 to 1e.06"),
    ("stray_scanner", put("camera_matrix.csv", "1, 2"), "camera_matrix.csv: intrinsics must be a 3x3 or 4x4 matrix"),
    ("stray_scanner", remove("camera_matrix.csv"), "camera_matrix.csv: no such file"),
    ("stray_scanner", cut("rgb.mp4"), "rgb.mp4: (can't be read as a video|must have a video track)"),
    ("stray_scanner", remove("depth/*"), "depth: must contain depth images"),
    ("r3d folder", put("metadata", "[1]"), "metadata: must contain an object with named values, got list"),
    ("r3d folder", put("metadata", "{}"), "metadata: must contain K, nine numbers column by column, got None"),
    ("r3d folder", put("metadata", '{"K": [1, 2]}'), "metadata: K must be rows of 9 numbers"),
    ("r3d folder", put("metadata", '{"fps": 1e-320}'), "fps must be a number from 0.001 to 1e.06, got 1e-320"),
    ("r3d folder", put("metadata", '{"fps": "fast"}'), "metadata: fps must be a number from 0.001 to 1e.06, got fast"),
    (
        "r3d folder",
        put("metadata", '{"frameTimestamps": [3, 2, 1, 1, 1]}'),
        "frameTimestamps must be finite and ascend",
    ),
    ("r3d folder", remove("rgbd/*.jpg"), "must contain rgbd/0.jpg and rgbd/0.depth .* got 0 color and 5 depth images"),
    ("r3d export", put("EXR_RGBD/depth/0.exr", "no image"), "0.exr: can't be read as an EXR image"),
    ("scannetpp", put("iphone/pose_intrinsic_imu.json", '{"a": 1}'), "must have an object per frame .* got a"),
    (
        "scannetpp",
        put("iphone/pose_intrinsic_imu.json", '{"frame_000000": {}}'),
        "frame_000000: pose must be a 4x4 matrix, got None",
    ),
    ("scannetpp", put("iphone/pose_intrinsic_imu.json", "{}"), "must contain frames with a pose, a color and a depth"),
    ("scannetpp", remove("iphone/rgb"), "must contain rgb.mkv or rgb.mp4, or rgb/frame_000000.jpg"),
    ("scannetpp", remove("iphone/depth"), "depth.bin: no such file"),
    ("arkitscenes", put("vga_wide_intrinsics/*", "1 2 3"), ".pincam: must be `width height fx fy cx cy`"),
    ("arkitscenes", put("vga_wide_intrinsics/*", "1e-320 24 30 30 16 12"), ".pincam: must be `width height fx fy cx"),
    ("arkitscenes", put("vga_wide_intrinsics/*", "32 24 1e308 30 16 12"), ".pincam: must be `width height fx fy cx cy"),
    ("arkitscenes", put("vga_wide_intrinsics/*", "nan 24 30 30 16 12"), ".pincam: must be `width height fx fy cx cy`"),
    ("arkitscenes", remove("vga_wide_intrinsics"), "vga_wide_intrinsics: no such folder"),
    ("arkitscenes", put("lowres_wide.traj", "1 2 3 4 5 6 north"), "lowres_wide.traj: must be `time rx ry rz tx ty tz`"),
    (
        "open3d",
        put("trajectory.log", "0 0 1\n1 0 0 0"),
        "trajectory.log: must have three whole numbers and a 4x4 matrix",
    ),
    ("open3d", put("intrinsic.json", '{"intrinsic_matrix": 3}'), "intrinsic_matrix must be nine numbers column by"),
    ("open3d", remove("depth/*"), "depth: must contain numbered images, got none"),
    ("icl_nuim", put("associations.txt", "a b c d"), "associations.txt: must list `number depth number color`"),
    ("icl_nuim", put("associations.txt", "1.5 rgb/0.png 1.5 depth/0.png"), "time stamps belong into the lists rgb.txt"),
    ("icl_nuim", put("associations.txt", ""), "associations.txt: must list at least one image, got none"),
    ("video", cut("color.avi"), None),
    ("video", remove("intrinsics.txt"), "must contain the intrinsics in one of intrinsics.txt"),
]


@pytest.mark.parametrize(("name", "spoil", "message"), BROKEN)
def test_what_is_broken_is_one_line(tmp_path, name, spoil, message):
    config, writer, _ = FORMATS[name]
    recording = writer(tmp_path / "mine", COUNT)
    spoil(recording)
    with pytest.raises(DatasetError, match=message) as error:
        open_dataset(load_config(config, overrides=[("dataset.path", str(recording))]).dataset)
    assert "\n" not in str(error.value)
    assert str(tmp_path) in str(error.value)


ELSEWHEN = " ".join(["1.0"] * 7) + "\n" + " ".join(["2.0"] * 7)


@pytest.mark.parametrize(
    ("name", "spoil", "words"),
    [
        ("arkitscenes", put("lowres_wide.traj", ELSEWHEN), r"lowres_wide.traj covers 1 to 2 s, the frames \d+"),
        ("arkitscenes", put("lowres_wide.traj", ""), "lowres_wide.traj holds no pose; write poses, or remove it"),
        ("icl_nuim", put("*.gt.freiburg", "77 0 0 0 0 0 0 1"), "livingRoom0.gt.freiburg hold no finite one for any"),
    ],
)
def test_poses_of_no_frame_are_a_doubt(tmp_path, name, spoil, words):
    config, writer, _ = FORMATS[name]
    recording = writer(tmp_path / "mine", COUNT)
    spoil(recording)
    dataset = open_dataset(load_config(config, overrides=[("dataset.path", str(recording))]).dataset)
    assert dataset.poses() is None
    (doubt,) = dataset.doubts
    assert re.search(words, str(doubt)), str(doubt)


def test_broken_archives_are_one_line(tmp_path):
    recording = write.write_record3d(tmp_path, COUNT)
    content = recording.read_bytes()
    for spoiled in (b"", content[: len(content) // 2], b"no archive" * 100):
        recording.write_bytes(spoiled)
        with pytest.raises(DatasetError, match="mine.r3d: can't be read as an .r3d archive"):
            open_path(recording)


@pytest.mark.parametrize(
    ("name", "image"),
    [
        ("stray_scanner", "depth/000002.png"),
        ("r3d folder", "rgbd/2.depth"),
        ("r3d folder", "rgbd/2.jpg"),
        ("r3d export", "EXR_RGBD/depth/2.exr"),
        ("scannetpp", "iphone/depth/frame_000002.png"),
        ("open3d", "color/000002.jpg"),
        ("icl_nuim", "depth/2.png"),
        ("video", "depth/2.png"),
    ],
)
def test_one_broken_image_is_one_broken_frame(tmp_path, name, image):
    recording = FORMATS[name][1](tmp_path / "mine", COUNT)
    truncate(recording / image)
    with prefetch(open_path(recording)) as frames:
        found = list(frames)
    faults = [i for i, frame in enumerate(found) if isinstance(frame, DatasetError)]
    assert faults == [2]
    assert str(recording) in str(found[2])
    assert Path(image).name in str(found[2])
    assert "\n" not in str(found[2])


OTHERS = {
    "7scenes": write_seven_scenes,
    "tum": write_tum,
    "replica": write_replica,
    "synthetic_rgbd": write_synthetic_rgbd,
    "scannet": write_scannet,
    "folder": write_folder,
}


@pytest.mark.parametrize("config", OTHERS)
def test_the_other_formats_are_found_out_too(tmp_path, config):
    recording = OTHERS[config](tmp_path / "mine")
    assert identify_recording(recording).config == config
    assert open_path(recording)[0].depth.any()


def test_what_is_no_recording(tmp_path):
    with pytest.raises(DatasetError, match="absent: no such configuration, file or folder"):
        identify_recording(tmp_path / "absent")
    with pytest.raises(
        DatasetError, match="is no recording that is known: must contain color/ and depth/.*it is empty"
    ):
        identify_recording(tmp_path)
    (tmp_path / "a.mp4").touch()
    (tmp_path / "b").mkdir()
    with pytest.raises(DatasetError, match="is no recording that is known: .*; it contains a.mp4, b/"):
        identify_recording(tmp_path)
    with pytest.raises(DatasetError, match="a video needs a folder with its depth images beside it"):
        identify_recording(tmp_path / "a.mp4")
