"""ScanNet's .sens: files written here from the published format, whole, and broken in the ways that files break."""

import struct
import threading

import numpy as np
import pytest

from spslam.camera import Camera
from spslam.datasets.base import RgbdFrame
from spslam.datasets.scannet import open_scannet
from spslam.errors import DatasetError
from tests.datasets.layouts import (
    HEIGHT,
    WIDTH,
    color_image,
    depth_meters,
    encoded,
    poses,
    sens_frame,
    sens_head,
    write_sens,
    zipped_depth,
)

CAMERA = Camera(WIDTH, HEIGHT, 30, 31, 15.5, 11.5)
FLOAT32 = 1e-6


def frame(i: int, **changes) -> bytes:
    values = {
        "pose": poses(i + 1)[i],
        "time_us": 1000 + 33_333 * i,
        "color": encoded(color_image(i), ".png"),
        "depth": zipped_depth(i),
    }
    return sens_frame(**{**values, **changes})


def write(path, frames, **head):
    path.write_bytes(sens_head(len(frames), **head) + b"".join(frames))
    return path


def test_a_scan(tmp_path):
    path = write_sens(tmp_path / "scene0000_00" / "scene0000_00.sens")
    for place in (path, path.parent):
        dataset = open_scannet(place)
        assert (dataset.name, len(dataset), dataset.camera) == ("scannet/scene0000_00", 4, CAMERA)
        np.testing.assert_allclose(dataset.timestamps(), 0.033333 * np.arange(4), atol=1e-9)
        np.testing.assert_allclose(dataset.poses(), poses(4), atol=FLOAT32)
        for i, found in enumerate(dataset):
            np.testing.assert_array_equal(found.color, color_image(i))
            np.testing.assert_allclose(found.depth, depth_meters(i), atol=FLOAT32)
            np.testing.assert_allclose(found.pose, poses(4)[i], atol=FLOAT32)
            assert (found.index, found.timestamp) == (i, dataset.timestamps()[i])


def test_frames_are_read_where_they_stand_from_any_thread(tmp_path):
    dataset = open_scannet(write_sens(tmp_path / "scan.sens", count=8))
    found: dict[int, RgbdFrame] = {}

    def read(indices):
        for index in indices:
            found[index] = dataset[index]

    threads = [threading.Thread(target=read, args=(range(start, 8, 4),)) for start in (3, 1, 0, 2)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    for i in range(8):
        np.testing.assert_allclose(found[i].depth, depth_meters(i), atol=FLOAT32)


def test_color_is_brought_to_the_size_of_depth(tmp_path):
    large = color_image(0).repeat(2, axis=0).repeat(2, axis=1)
    color = encoded(large, ".jpg")
    path = write(tmp_path / "a.sens", [frame(0, color=color)], color=2, color_size=(2 * WIDTH, 2 * HEIGHT))
    found = open_scannet(path)[0]
    assert found.color.shape == (HEIGHT, WIDTH, 3)
    # JPEG's own error, away from the edge.
    assert np.abs(found.color.astype(int) - color_image(0))[:, :8].max() < 10


def test_raw_images(tmp_path):
    stored = np.round(1000 * depth_meters(0)).astype("<u2").tobytes()
    path = write(tmp_path / "a.sens", [frame(0, color=color_image(0).tobytes(), depth=stored)], color=0, depth=0)
    found = open_scannet(path)[0]
    np.testing.assert_array_equal(found.color, color_image(0))
    np.testing.assert_allclose(found.depth, depth_meters(0), atol=FLOAT32)
    found.color[0], found.depth[0] = 0, 0


def test_unknown_poses_are_minus_infinity(tmp_path):
    frames = [frame(0), frame(1, pose=np.full((4, 4), -np.inf)), frame(2, pose=np.full((4, 4), np.nan))]
    dataset = open_scannet(write(tmp_path / "a.sens", frames))
    assert [found.pose is None for found in dataset] == [False, True, True]
    assert np.isnan(dataset.poses()[1:]).all()
    assert open_scannet(write(tmp_path / "b.sens", frames[1:])).poses() is None


def test_times(tmp_path):
    # Written out of order: put in order. Without times: 30 Hz. The same time twice: the second can't be used.
    shuffled = open_scannet(write(tmp_path / "a.sens", [frame(i) for i in (2, 0, 1)]))
    np.testing.assert_allclose(shuffled.timestamps(), 0.033333 * np.arange(3), atol=1e-9)
    for i, found in enumerate(shuffled):
        np.testing.assert_allclose(found.depth, depth_meters(i), atol=FLOAT32)
    timeless = open_scannet(write(tmp_path / "b.sens", [frame(i, time_us=0) for i in range(3)]))
    np.testing.assert_allclose(timeless.timestamps(), np.arange(3) / 30)
    twice = open_scannet(write(tmp_path / "c.sens", [frame(0), frame(1), frame(2, time_us=34_333)]))
    with pytest.raises(
        DatasetError, match=r"c.sens, frame 2: must be later than frame 1, got the same time 0.033333 s"
    ):
        twice[2]
    assert twice[1].pose is not None
    huge = open_scannet(write(tmp_path / "d.sens", [frame(i, time_us=2**64 - 50 + i) for i in range(2)]))
    np.testing.assert_allclose(huge.timestamps(), [0, 1e-6])


def test_a_pose_that_is_no_motion_is_unknown(tmp_path):
    dataset = open_scannet(write(tmp_path / "a.sens", [frame(0), frame(1, pose=np.ones((4, 4))), frame(2)]))
    assert [dataset[index].pose is None for index in range(3)] == [False, True, False]
    (doubt,) = dataset.doubts
    assert "a.sens, frame 1, pose: must be a rotation and a translation" in str(doubt)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"color": encoded(color_image(0), ".png")[:-30]}, "frame 1, color: the image is truncated"),
        ({"color": b""}, "frame 1, color: the image is truncated"),
        ({"color": b"IEND no image"}, "frame 1, color: can't be decoded as an image"),
        ({"depth": zipped_depth(0)[:-8]}, "frame 1, depth: can't be decompressed"),
        ({"depth": b""}, "frame 1, depth: can't be decompressed"),
    ],
)
def test_a_broken_frame_is_named_and_leaves_the_others(tmp_path, changes, message):
    dataset = open_scannet(write(tmp_path / "a.sens", [frame(0), frame(1, **changes), frame(2)]))
    with pytest.raises(DatasetError, match=rf"a.sens, {message}") as error:
        dataset[1]
    assert "\n" not in str(error.value)
    assert dataset[0].pose is not None
    np.testing.assert_allclose(dataset[2].depth, depth_meters(2), atol=FLOAT32)


def test_images_of_another_size_than_announced(tmp_path):
    short = np.ones(5, "<u2").tobytes()
    path = write(tmp_path / "a.sens", [frame(0), frame(1, color=b"abc", depth=short)], color=0, depth=0)
    with pytest.raises(DatasetError, match="frame 1, color: must be 2304 bytes, got 3"):
        open_scannet(path)[1]
    path = write(tmp_path / "b.sens", [frame(0), frame(1, depth=short)], depth=0)
    with pytest.raises(DatasetError, match="frame 1, depth: must be 1536 bytes, got 10"):
        open_scannet(path)[1]


@pytest.mark.parametrize("missing", [1, 120, 1000])
def test_a_file_that_was_cut_gives_its_whole_frames(tmp_path, missing):
    whole = write(tmp_path / "a.sens", [frame(i) for i in range(4)]).read_bytes()
    (tmp_path / "a.sens").write_bytes(whole[:-missing])
    dataset = open_scannet(tmp_path / "a.sens")
    last = len(dataset) - 1
    assert 2 <= last <= 3
    assert (np.diff(dataset.timestamps()) > 0).all()
    assert np.isfinite(dataset.poses()).all(axis=(1, 2)).tolist() == [True] * last + [False]
    np.testing.assert_allclose(dataset[last - 1].depth, depth_meters(last - 1), atol=FLOAT32)
    with pytest.raises(DatasetError, match=f"a.sens: the file is truncated: {last} of 4 frames are whole"):
        dataset[last]


def changed(content: bytes, offset: int, new: bytes) -> bytes:
    return content[:offset] + new + content[offset + len(new) :]


# Offsets behind the name of 15 letters.
MATRICES, COMPRESSIONS = 12 + 15, 12 + 15 + 256


@pytest.mark.parametrize(
    ("corrupt", "message"),
    [
        (lambda content: b"", "the file is empty"),
        (lambda content: content[:100], "the file is truncated in its head"),
        (lambda content: changed(content, 0, struct.pack("<I", 3)), "must be a .sens file of version 4, got 3"),
        (lambda content: changed(content, 4, b"\xff" * 8), "its sensor's name would be 18446744073709551615 bytes"),
        (lambda content: changed(content, COMPRESSIONS, struct.pack("<2i", 2, 2)), "got 2 and 2"),
        (
            lambda content: changed(content, COMPRESSIONS + 8, bytes(4)),
            "an image must have 1 to 16777216 pixels and at most 32768 along a side, got 0x24",
        ),
        (
            lambda content: changed(content, COMPRESSIONS + 24, bytes(4)),
            "depth_shift must be a number from 0.001 to 1e.09, got 0.0",
        ),
        (
            lambda content: changed(content, MATRICES + 128, bytes(64)),
            "intrinsics of depth: .*matrix must have the form",
        ),
        (lambda content: content[:350], "must contain a whole frame, got none of 2"),
    ],
)
def test_a_broken_file(tmp_path, corrupt, message):
    path = write(tmp_path / "a.sens", [frame(0), frame(1)])
    path.write_bytes(corrupt(path.read_bytes()))
    with pytest.raises(DatasetError, match=rf"a.sens.*{message}") as error:
        open_scannet(path)
    assert "\n" not in str(error.value)


def test_a_missing_file(tmp_path):
    with pytest.raises(DatasetError, match="a.sens: no such file"):
        open_scannet(tmp_path / "a.sens")
