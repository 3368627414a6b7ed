"""Live runs from start to end: results, latency, dropped frames, cameras that fail, Ctrl-C."""

import contextlib
import json
import os
import signal
import subprocess
import sys
import threading
import time
from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch

from spslam.cli.live_progress import LiveProgress
from spslam.config import load_config
from spslam.datasets import open_dataset
from spslam.errors import DatasetError, DeviceError, OutputError, SourceError, SpslamError
from spslam.evaluation.run_output import RunOutput
from spslam.live import FolderRecorder, LiveRequest, ReplaySource, capture, session
from spslam.live.frame_queue import FrameQueue
from spslam.live.loop import LiveStatus
from spslam.live.session import run_live
from spslam.slam.system import SlamSystem
from spslam.trajectory import Trajectory
from tests.cli.command import ROOT, assert_refused, spslam
from tests.live.sources import RoomCamera
from tests.system.sequences import Recorded, settings, without_depth

FILES = {"config.yaml", "keyframes.safetensors", "log.jsonl", "map.safetensors", "metrics.json", "previews"}
FILES |= {"report.html", "trajectory.txt"}
SMALL = [
    "--set=dataset.width=96",
    "--set=dataset.height=72",
    "--set=pixels.per_frame=3000",
    "--set=mapping.first_iterations=20",
    "--device=cpu",
]


def request(tmp_path, *overrides, **arguments):
    config = settings("mapping.first_iterations=12", "run.previews=2", "device=cpu", *overrides)
    # Nothing is dropped, so that tests do not depend on the machine.
    return LiveRequest(config, tmp_path / "out", **{"max_wait_s": 60.0, "mesh": False, **arguments})


def test_a_camera_leaves_what_a_run_leaves(tmp_path):
    camera, seen = RoomCamera(8, pause_s=0.01), []
    asked = request(tmp_path, record_dir=tmp_path / "recorded", mesh=True)
    metrics = run_live(asked, camera, lambda status: seen.append((status.frames, status.ending)))
    assert {path.name for path in (tmp_path / "out").iterdir()} == FILES | {"mesh.ply"}
    assert camera.closed == 1
    assert seen == [(n, False) for n in range(1, 9)] + [(8, True)]
    output = RunOutput.read(tmp_path / "out")
    assert len(output.trajectory) == metrics["frames"] == metrics["received_frames"] == 8
    assert not output.trajectory.lost.any()
    assert output.ground_truth is None
    assert [preview.row for preview in output.previews()] == [0, 6]
    assert len(output.mesh().faces) > 1000
    assert metrics["dropped_frames"] == metrics["unrecorded_frames"] == 0
    assert metrics["recorded_frames"] == 8
    assert metrics["data"]["source"] == "test camera"
    # Those of the first frame are spread over the next five. Where the next frame always waits, each of these brings
    # one iteration, half of its share; of what is then left so much is dropped that a call has no more than 12.
    made = [row["mapping_iterations"] for row in output.log]
    assert 12 + 10 - 5 <= sum(made) <= 12 + 10 and min(made) >= 1
    assert 0 < metrics["latency_p50_ms"] <= metrics["latency_p99_ms"] <= metrics["latency_max_ms"]
    assert all(row["latency_ms"] > row["queue_ms"] >= 0 and row["dropped"] == 0 for row in output.log)
    page = (ROOT / "docs" / "outputs.md").read_text()
    assert not [key for key in {**metrics, **output.log[0]} if f"`{key}`" not in page]
    # What was recorded can be run, with the options of the live run.
    again = load_config(tmp_path / "out" / "config.yaml")
    assert again == asked.config


def test_mesh_command_makes_the_mesh_of_a_live_run_again(tmp_path):
    small = ["pixels.per_frame=3000", "mapping.first_iterations=12", "device=cpu"]
    run_live(LiveRequest(load_config("folder", "fast", small), tmp_path / "out", max_wait_s=60.0), RoomCamera(3))
    own = (tmp_path / "out" / "mesh.ply").read_bytes()
    result = spslam("mesh", "out", cwd=tmp_path)
    assert result.returncode == 0, result.stderr
    assert "neural at 0.01 m" in result.stdout
    assert (tmp_path / "out" / "mesh.ply").read_bytes() == own
    refused = spslam("mesh", "out", "--source", "tsdf", cwd=tmp_path)
    assert_refused(refused, "the frames of a live run can't be read again; --source neural needs none")


def test_a_replay_is_compared_with_its_ground_truth(tmp_path, device):
    metrics = run_live(request(tmp_path, f"device={device.type}"), ReplaySource(Recorded(8), 100))
    assert metrics["ate_rmse_cm"] < 1
    assert (tmp_path / "out" / "previews" / "ground_truth.txt").is_file()


def test_the_map_of_a_replay_begins_where_its_first_usable_frame_is(tmp_path):
    run_live(request(tmp_path), ReplaySource(Recorded(6, without_depth(0, 1)), 100))
    poses = Trajectory.load_tum(tmp_path / "out" / "trajectory.txt").poses
    np.testing.assert_allclose(poses[2], Recorded(6).poses()[2], atol=1e-6)


def test_late_frames_are_dropped_and_counted(tmp_path, monkeypatch):
    submit = SlamSystem.submit
    monkeypatch.setattr(SlamSystem, "submit", lambda *args, **more: time.sleep(0.03) or submit(*args, **more))
    metrics = run_live(request(tmp_path, max_wait_s=0.02), ReplaySource(Recorded(20), 200))
    rows = [json.loads(line) for line in (tmp_path / "out" / "log.jsonl").read_text().splitlines()]
    assert metrics["dropped_frames"] >= 5
    assert metrics["frames"] + metrics["dropped_frames"] == metrics["received_frames"] == 20
    assert sum(row["dropped"] for row in rows) <= metrics["dropped_frames"]
    steps = np.diff([-1] + [row["index"] for row in rows])
    assert [row["dropped"] for row in rows] == (steps - 1).tolist()


def test_frames_that_cannot_be_used_are_noted(tmp_path):
    def fault(frame):
        return DatasetError("test camera: no depth") if frame.index == 2 else frame

    metrics = run_live(request(tmp_path), RoomCamera(5, change=fault))
    assert (metrics["frames"], metrics["skipped_frames"], metrics["received_frames"]) == (4, 1, 5)
    rows = [json.loads(line) for line in (tmp_path / "out" / "log.jsonl").read_text().splitlines()]
    assert [(row["index"], row["dropped"]) for row in rows] == [(0, 0), (1, 0), (3, 0), (4, 0)]
    assert "no depth" in (tmp_path / "out" / "skipped.jsonl").read_text()


def test_a_camera_may_use_its_memory_again(tmp_path):
    own = Recorded(8)
    color, depth = np.empty_like(own[0].color), np.empty_like(own[0].depth)

    def written_again(frame):
        color[:], depth[:] = frame.color, frame.depth
        return replace(frame, color=color, depth=depth)

    run_live(request(tmp_path, record_dir=tmp_path / "recorded"), RoomCamera(8, change=written_again))
    recorded = open_dataset(load_config("folder").dataset, tmp_path / "recorded")
    for frame, other in zip(recorded, own, strict=True):
        np.testing.assert_allclose(frame.depth, other.depth, atol=0.00051)
        assert np.abs(frame.color.astype(int) - other.color).mean() < 3
    for preview in RunOutput.read(tmp_path / "out").previews():
        np.testing.assert_array_equal(preview.color, own[preview.row].color)


@pytest.mark.parametrize(
    ("fault", "kind", "message"),
    [
        (SourceError("test camera: unplugged"), SourceError, "unplugged; the results of 4 frames are in .*out"),
        (RuntimeError("odd"), RuntimeError, "^odd$"),
    ],
)
def test_when_the_camera_fails_the_results_are_written_and_then_it_is_said(tmp_path, fault, kind, message):
    with pytest.raises(kind, match=message):
        run_live(request(tmp_path), RoomCamera(4, fault=fault))
    assert len(RunOutput.read(tmp_path / "out").trajectory) == 4


@pytest.mark.parametrize(
    ("camera", "kind", "message"),
    [
        (RoomCamera(0), SourceError, "test camera: ended before a frame was tracked"),
        (RoomCamera(0, fault=SourceError("test camera: absent")), SourceError, "^test camera: absent$"),
        (RoomCamera(2, change=lambda f: DatasetError("bad")), SourceError, "2 could not be used"),
        (RoomCamera(1, change=lambda f: f.__class__(0, 0.0, f.color, f.depth[::2])), SourceError, "camera's shape"),
        (RoomCamera(1, change=lambda f: (f.color, f.depth)), SourceError, "must yield RgbdFrame .*, got tuple"),
    ],
)
def test_without_a_frame_nothing_is_left_behind(tmp_path, camera, kind, message):
    with pytest.raises(kind, match=message):
        run_live(request(tmp_path, record_dir=tmp_path / "recorded"), camera)
    assert not list(tmp_path.iterdir())
    assert camera.closed == 1


@pytest.mark.parametrize("has_poses", [False, True])
@pytest.mark.parametrize(
    ("limits", "message"),
    [
        (["scene.max_voxels=16200", "mapping.every=1", "scene.first_pose=identity"], "max_voxels"),
        (["pixels.budget_mb=0.01", "pixels.per_frame=200"], "pixels.budget_mb"),
    ],
)
def test_a_limit_that_is_reached_leaves_the_results(tmp_path, has_poses, limits, message):
    camera = RoomCamera(20, pause_s=0.02, has_poses=has_poses)
    with pytest.raises(SpslamError, match=message + r".*; the results of [1-9]\d* frames are in"):
        run_live(request(tmp_path, *limits), camera)
    output = RunOutput.read(tmp_path / "out")
    assert 1 <= len(output.trajectory) < 20
    assert not output.trajectory.lost.any()
    assert (output.ground_truth is not None) == has_poses
    np.testing.assert_allclose(np.linalg.norm(output.trajectory.poses[:, :3, :3], axis=1), 1, atol=1e-5)


@pytest.mark.parametrize(
    ("time_s", "kind", "message"),
    [
        (float("nan"), ValueError, "test camera: timestamp must be a finite number of seconds, got nan"),
        (float("inf"), ValueError, "test camera: timestamp must be a finite number of seconds, got inf"),
        (None, TypeError, "test camera: timestamp must be a number of seconds, got NoneType"),
    ],
)
def test_a_time_that_is_none_leaves_the_results(tmp_path, time_s, kind, message):
    camera = RoomCamera(6, change=lambda frame: replace(frame, timestamp=time_s) if frame.index == 3 else frame)
    with pytest.raises(kind, match=message):
        run_live(request(tmp_path), camera)
    assert len(RunOutput.read(tmp_path / "out").trajectory) == 3


@pytest.mark.parametrize(
    ("where", "fault", "kind", "message"),
    [
        ("submit", torch.OutOfMemoryError("too much"), DeviceError, "out of memory.*the results of 3 frames are in"),
        ("finish", SpslamError("a process has ended"), SpslamError, "has ended; the results of 4 frames are in"),
    ],
)
def test_whatever_fails_in_the_system_leaves_the_results(tmp_path, monkeypatch, where, fault, kind, message):
    def fail(system, *arguments, **more):
        if system.state.frames.processed >= 3:
            raise fault
        return own(system, *arguments, **more)

    own = getattr(SlamSystem, where)
    monkeypatch.setattr(SlamSystem, where, fail)
    monkeypatch.setattr(session, "warm_up", lambda *_: None)  # on a system of its own
    with pytest.raises(kind, match=message):
        run_live(request(tmp_path), RoomCamera(4))
    assert len(RunOutput.read(tmp_path / "out").trajectory) == (3 if where == "submit" else 4)


def test_a_progress_that_fails_leaves_the_results(tmp_path):
    def progress(status):
        assert status.frames < 3, "odd"

    with pytest.raises(AssertionError, match="odd"):
        run_live(request(tmp_path), RoomCamera(6), progress)
    assert len(RunOutput.read(tmp_path / "out").trajectory) == 3


def test_a_display_that_nobody_reads_any_more_is_no_reason_to_end(monkeypatch):
    reading, writing = os.pipe()
    os.close(reading)
    with open(writing, "w") as closed:
        monkeypatch.setattr(sys, "stderr", closed)
        progress = LiveProgress(on_terminal=False)
        progress(LiveStatus(frames=3, ending=True))
        with pytest.raises(BrokenPipeError):
            closed.flush()
        os.dup2(os.open(os.devnull, os.O_WRONLY), writing)  # for what is left of it


@pytest.mark.parametrize("where", ["before the folder", "in the folder"])
def test_a_source_is_closed_where_the_run_can_not_begin(tmp_path, monkeypatch, where):
    camera, asked = RoomCamera(3), request(tmp_path)
    if where == "in the folder":
        asked.output_dir.mkdir()
        (asked.output_dir / "notes.txt").touch()
    else:

        def fail(*_):
            raise SpslamError("no memory")

        monkeypatch.setattr(session, "warm_up", fail)
    with pytest.raises(SpslamError):
        run_live(asked, camera)
    assert camera.closed == 1


def test_a_recording_that_fails_is_said_after_the_results(tmp_path, monkeypatch):
    def full(*_):
        raise OutputError("color/000000.jpg: can't be written: No space left on device")

    monkeypatch.setattr(FolderRecorder, "_write", full)
    with pytest.raises(OutputError, match="No space left on device; the results of 4 frames are in"):
        run_live(request(tmp_path, record_dir=tmp_path / "recorded"), RoomCamera(4))
    assert json.loads((tmp_path / "out" / "metrics.json").read_text())["unrecorded_frames"] == 4


def test_a_source_that_does_not_end_is_left_alone(tmp_path, monkeypatch):
    monkeypatch.setattr(capture, "_END_S", 0.1)
    forever = threading.Event()
    camera = RoomCamera(4, change=lambda frame: forever.wait(20) and frame if frame.index == 3 else frame)
    with pytest.raises(SourceError, match=r"did not end within 0.1 s; it is left alone; the results of 3 frames"):
        run_live(request(tmp_path, seconds=1.0), camera)
    forever.set()


def test_a_source_that_does_not_end_is_waited_for_once(monkeypatch):
    monkeypatch.setattr(capture, "_END_S", 0.5)
    forever = threading.Event()
    camera = RoomCamera(1, change=lambda frame: forever.wait(20) and frame)
    with capture.Capture(camera, FrameQueue(1.0)) as capturing:
        capturing.stop()
        began = time.monotonic()
    assert time.monotonic() - began < 0.25
    assert "did not end within 0.5 s" in str(capturing.failure)
    forever.set()


def test_the_folder_of_a_killed_run_is_refused(tmp_path):
    asked = request(tmp_path)
    asked.output_dir.mkdir()
    (asked.output_dir / "config.yaml").touch()
    with pytest.raises(OutputError, match="out: holds a run that did not end; use another --output"):
        run_live(asked, RoomCamera(2))
    assert [path.name for path in asked.output_dir.iterdir()] == ["config.yaml"]


def test_a_live_run_ends_after_the_time_asked_for(tmp_path):
    metrics = run_live(request(tmp_path, seconds=0.5), RoomCamera(20, pause_s=0.2))
    assert 1 <= metrics["frames"] < 19


def test_ctrl_c_ends_with_all_results(tmp_path):
    command = [sys.executable, "-m", "spslam", "live", "replay", "demo", *SMALL, "--rate", "20", "--output", "out"]
    command += ["--max-wait", "60000"]
    process = subprocess.Popen(
        command, cwd=tmp_path, env={"PYTHONPATH": str(ROOT)}, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    log = tmp_path / "out" / "log.jsonl"
    while process.poll() is None and not (log.is_file() and log.read_text().count("\n") >= 3):
        time.sleep(0.01)
    process.send_signal(signal.SIGINT)
    output, error = process.communicate(timeout=120)
    assert process.returncode == 0, error
    assert {path.name for path in (tmp_path / "out").iterdir()} == FILES | {"mesh.ply"}
    assert "ending: completing the map, writing the results" in error
    assert "latency p99" in output
    assert 3 <= json.loads((tmp_path / "out" / "metrics.json").read_text())["frames"] < 300


def test_one_ctrl_c_does_not_cost_the_results_that_are_being_written(tmp_path, monkeypatch):
    def write(*arguments):
        signal.raise_signal(signal.SIGINT)
        time.sleep(0.01)
        return write_results(*arguments)

    write_results = session.write_results
    monkeypatch.setattr(session, "write_results", write)
    assert run_live(request(tmp_path), RoomCamera(2))["frames"] == 2


def test_ctrl_c_twice_before_a_frame_leaves_nothing_behind(tmp_path):
    def interrupted(frame):
        os.kill(os.getpid(), signal.SIGINT)  # wakes the main thread
        time.sleep(0.3)
        os.kill(os.getpid(), signal.SIGINT)  # wakes the main thread
        return forever.wait(20) and frame

    forever, began = threading.Event(), time.monotonic()
    with pytest.raises(KeyboardInterrupt):
        run_live(request(tmp_path, record_dir=tmp_path / "recorded"), RoomCamera(1, change=interrupted))
    assert time.monotonic() - began < 8  # a camera that does not answer is not waited for
    assert not list(tmp_path.iterdir())
    forever.set()


def test_a_mask_leaves_pixels_out(tmp_path, monkeypatch):
    """Black in a half; black in all but a corner, so that no frame has enough depth."""
    monkeypatch.chdir(tmp_path)
    image = np.zeros((RoomCamera(3).camera.height, RoomCamera(3).camera.width), np.uint8)
    for rows, columns in ((None, image.shape[1] // 2), (4, 4)):
        image[:] = 0
        image[:rows, :columns] = 255
        assert cv2.imwrite("mask.png", image)
        with pytest.raises(DatasetError) if rows else contextlib.nullcontext():
            run_live(
                replace(request(tmp_path, "dataset.mask=mask.png"), output_dir=tmp_path / str(rows)), RoomCamera(3)
            )
    # It holds in any working directory.
    assert load_config(tmp_path / "None" / "config.yaml").dataset.mask == str(tmp_path / "mask.png")


def test_the_command_replays_and_records(tmp_path):
    arguments = ["demo", *SMALL, "--frames", "0:6", "--rate", "100", "--max-wait", "60000", "--no-mesh"]
    result = spslam("live", "replay", *arguments, "--output", "out", "--record", "rec", cwd=tmp_path)
    assert result.returncode == 0, result.stderr
    assert "frames        6\n" in result.stdout
    assert "6 frames, " in result.stderr
    again = spslam("run", "folder", "--data", "rec", "--device", "cpu", "--output", "again", "--no-mesh", cwd=tmp_path)
    assert "frames        6\n" in again.stdout
    refused = spslam("live", "replay", *arguments, "--output", "new", "--record", "rec", cwd=tmp_path)
    assert_refused(refused, "rec: is not empty; record into another folder")
    assert not (tmp_path / "new").exists()
    assert_refused(spslam("live", "replay", *arguments, "--output", "out", cwd=tmp_path), "holds a finished run")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ([], "the following arguments are required: SOURCE"),
        (["webcam"], "invalid choice: 'webcam'"),
        (["replay", "demo", "--rate", "0"], "--rate: must be a rate in Hz above 0, got '0'"),
        (["replay", "demo", "--repeat", "0"], "--repeat: must be a whole number of at least 1"),
        (["replay", "demo", "--max-wait", "-1"], "--max-wait: must be a time in milliseconds of at least 0"),
        (["replay", "tum", "--data", "absent"], "absent: no such folder"),
        (["realsense", "--size", "640"], "--size: must be WIDTHxHEIGHT such as 640x480, got '640'"),
        (
            ["realsense", "--recording", "x.bag", "--rate", "15"],
            "--recording has the sizes and rate it was recorded with",
        ),
    ],
)
def test_a_wrong_command_line_is_one_line(tmp_path, arguments, message):
    assert_refused(spslam("live", *arguments, cwd=tmp_path), message)
    assert not list(tmp_path.iterdir())
