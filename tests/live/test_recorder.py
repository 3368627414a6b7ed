"""What a recorder writes is read by the `folder` dataset, whatever happens while it is written."""

import os
import time
from dataclasses import replace

import numpy as np
import pytest

from spslam.config import load_config
from spslam.datasets import open_dataset
from spslam.errors import OutputError
from spslam.live import recorder as module
from spslam.live.recorder import FolderRecorder
from tests.live.sources import plain_frame
from tests.system.sequences import Recorded


def opened(folder):
    return open_dataset(load_config("folder").dataset, folder)


def test_a_recording_has_the_frames_as_they_came(tmp_path):
    dataset, folder = Recorded(4), tmp_path / "a" / "b"
    with FolderRecorder(folder, dataset.camera) as recorder:
        for frame in dataset:
            recorder.offer(frame)
    assert repr(recorder) == f"FolderRecorder({str(folder)!r}, 4 frames, 0 left out)"
    recorded = opened(folder)
    assert recorded.camera == dataset.camera
    assert len(recorded) == 4
    np.testing.assert_allclose(recorded.poses(), dataset.poses(), atol=1e-9)
    for one, other in zip(recorded, dataset, strict=True):
        np.testing.assert_allclose(one.depth, other.depth, atol=0.00051)
        assert np.abs(one.color.astype(int) - other.color).mean() < 3  # levels of 255: JPEG of noise
    times = np.loadtxt(folder / "times.txt")
    np.testing.assert_allclose(times, dataset.timestamps(), atol=1e-8)


@pytest.mark.parametrize("known", [(0, 3), (2, 3), (3,)])
def test_poses_that_begin_late_or_are_missing_are_kept(tmp_path, known):
    """As of a motion capture system that finds the camera after a while."""
    dataset = Recorded(4)
    with FolderRecorder(tmp_path / "x", dataset.camera) as recorder:
        for frame in dataset:
            frame.pose = frame.pose if frame.index in known else None
            recorder.offer(frame)
    recorded = opened(tmp_path / "x")
    assert recorded.doubts == dataset.doubts
    for index, pose in enumerate(recorded.poses()):
        if index in known:
            np.testing.assert_allclose(pose, dataset.poses()[index], atol=1e-9)
        else:
            assert np.isnan(pose).all()


def test_frames_without_any_pose_have_no_poses(tmp_path):
    with FolderRecorder(tmp_path / "x", Recorded(1).camera) as recorder:
        recorder.offer(plain_frame(0))
    assert not (tmp_path / "x" / "poses.txt").exists()


def test_a_kill_where_the_first_pose_comes_late_leaves_a_recording(tmp_path, monkeypatch):
    """The rows of the frames before it are there, and nothing of the frame itself but its images."""
    dataset, folder = Recorded(3), tmp_path / "x"

    def killed(self, file, row):
        if file.name.endswith("poses.txt"):
            raise OutputError("killed")
        append(self, file, row)

    append = FolderRecorder._append
    monkeypatch.setattr(FolderRecorder, "_append", killed)
    with FolderRecorder(folder, dataset.camera) as recorder:
        for frame in dataset:
            frame.pose = frame.pose if frame.index == 2 else None
            recorder.offer(frame)
    assert (folder / "color" / "000002.jpg").exists()
    assert len(opened(folder)) == 2 and opened(folder).poses() is None


@pytest.mark.parametrize(
    ("stamps", "times"),
    [
        ([0, 0.1, 0.2, 3.2, 3.3], [0, 0.1, 0.2, 3.2, 3.3]),
        ([9, 9.1, 9.2, 5.2, 5.3, 5.4, 0.1], [9, 9.1, 9.2, 9.3, 9.4, 9.5, 9.6]),
        ([0, 0.1, 0.1, 0.2, 0.2, 0.3], [0, 0.1, 0.15, 0.2, 0.25, 0.3]),
        ([7, 7, 7], [7, 7 + 1 / 60, 7 + 2 / 60]),
        ([1.7e9, 1.7e9 + 0.1, 0, 0.1], [1.7e9, 1.7e9 + 0.1, 1.7e9 + 0.2, 1.7e9 + 0.3]),
    ],
)
def test_times_ascend_whatever_the_clock_of_the_camera_does(tmp_path, stamps, times):
    with FolderRecorder(tmp_path / "rec", Recorded(1).camera) as recorder:
        for stamp in stamps:
            recorder.offer(replace(plain_frame(), timestamp=stamp))
    np.testing.assert_allclose(opened(tmp_path / "rec").timestamps(), times, rtol=0, atol=1e-6)


def test_frames_that_come_too_fast_are_left_out_and_counted(tmp_path, monkeypatch):
    monkeypatch.setattr(module, "WAITING_FRAMES", 3)
    write, offered = FolderRecorder._write, 0
    monkeypatch.setattr(FolderRecorder, "_write", lambda *args: time.sleep(0.02) or write(*args))
    recorder, began = FolderRecorder(tmp_path / "x", Recorded(1).camera), time.monotonic()
    for number in range(20):
        recorder.offer(plain_frame(number))
        offered += 1
    assert time.monotonic() - began < 0.2  # nothing was waited for
    recorder.close()
    assert recorder.left_out > 0
    assert recorder.frames + recorder.left_out == offered
    dataset = opened(tmp_path / "x")
    assert len(dataset) == recorder.frames == len(np.loadtxt(tmp_path / "x" / "times.txt"))


def test_a_failing_disk_ends_the_recording_and_says_so(tmp_path, monkeypatch):
    replaced = os.replace

    def full(source, target):
        if "000002" in str(target):
            raise OSError(28, "No space left on device")
        return replaced(source, target)

    monkeypatch.setattr(module.os, "replace", full)
    with FolderRecorder(tmp_path / "x", Recorded(1).camera) as recorder:
        for number in range(6):
            recorder.offer(plain_frame(number))
    assert isinstance(recorder.failure, OutputError)
    assert "000002.png: can't be written: No space left on device" in str(recorder.failure)
    assert (recorder.frames, recorder.left_out) == (2, 4)
    assert not list((tmp_path / "x").rglob(".*"))
    assert len(opened(tmp_path / "x")) == 2


def test_a_frame_that_can_not_be_written_ends_the_recording_and_says_so(tmp_path):
    broken = plain_frame(1)
    broken.depth = None
    with FolderRecorder(tmp_path / "x", Recorded(1).camera) as recorder:
        for frame in (plain_frame(0), broken, plain_frame(2)):
            recorder.offer(frame)
    assert isinstance(recorder.failure, OutputError)
    assert "x: frame 1 can't be written: unsupported operand" in str(recorder.failure)
    assert (recorder.frames, recorder.left_out) == (1, 2)


def test_a_recording_without_a_frame_is_removed(tmp_path):
    for _ in range(2):
        with FolderRecorder(tmp_path / "rec", Recorded(1).camera):
            pass
        assert not list(tmp_path.iterdir())


def test_a_folder_with_something_in_it_is_refused(tmp_path):
    (tmp_path / "note").touch()
    with pytest.raises(OutputError, match="is not empty; record into another folder"):
        FolderRecorder(tmp_path, Recorded(1).camera)
    with pytest.raises(OutputError, match="can't be written: Not a directory"):
        FolderRecorder(tmp_path / "note", Recorded(1).camera)


def test_depth_beyond_16_bits_is_unknown(tmp_path):
    frame = plain_frame()
    frame.depth[0, 0] = 70.0
    with FolderRecorder(tmp_path / "x", Recorded(1).camera) as recorder:
        recorder.offer(frame)
    assert opened(tmp_path / "x")[0].depth[0, 0] == 0


@pytest.mark.parametrize("missing", [[], ["color"]], ids=["without its time", "without its color"])
def test_a_frame_that_a_kill_interrupted_is_left_out(tmp_path, missing):
    folder = tmp_path / "x"
    with FolderRecorder(folder, Recorded(1).camera) as recorder:
        for number in range(4):
            recorder.offer(plain_frame(number))
    rows = (folder / "times.txt").read_text().splitlines(keepends=True)
    (folder / "times.txt").write_text("".join(rows[:3]))
    for kind in missing:
        (folder / kind / "000003.jpg").unlink()
    dataset = opened(folder)
    assert [dataset[i].timestamp for i in range(len(dataset))] == pytest.approx([0, 1 / 30, 2 / 30])


def test_depth_that_is_not_above_0_is_unknown(tmp_path):
    frame = plain_frame()
    frame.depth[0, :4] = -1.0, -np.inf, np.nan, np.inf
    with FolderRecorder(tmp_path, Recorded(1).camera) as recorder:
        recorder.offer(frame)
    (recorded,) = opened(tmp_path)
    assert recorded.depth[0, :4].tolist() == [0, 0, 0, 0]
    assert recorded.depth[0, 4] == 1
