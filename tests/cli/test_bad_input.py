"""Invalid input: a one-line error, exit code 2, and no partial output."""

import shutil
import sys

import numpy as np
import pytest
import torch

from spslam.cli.main import main
from tests.cli.command import assert_refused, spslam
from tests.datasets import layouts


@pytest.fixture
def scene(tmp_path):
    return layouts.write_seven_scenes(tmp_path / "scene")


def run(tmp_path, *arguments):
    return spslam("run", *arguments, "--output", "out", "--device", "cpu", cwd=tmp_path)


def sequence(scene, name):
    return scene / "seq-01" / name


def break_images(scene):
    for path in scene.rglob("*.color.png"):
        layouts.truncate(path)


def break_depths(scene):
    for path in scene.rglob("*.depth.png"):
        path.write_bytes(b"")


def shrink_depths(scene):
    for path in scene.rglob("*.depth.png"):
        layouts.write_depth(path, np.ones((10, 10)))


def remove_frames(scene):
    for path in scene.rglob("frame-*"):
        path.unlink()


def replace_by_file(scene):
    shutil.rmtree(scene)
    scene.write_text("not a folder")


def replace_by_other_layout(scene):
    shutil.rmtree(scene)
    layouts.write_tum(scene)


def break_intrinsics(scene):
    (scene / "camera-intrinsics.txt").write_text("1 2 3\n4 5 6\n")


DAMAGES = {
    "no such folder": shutil.rmtree,
    "must be a folder": replace_by_file,
    "7-Scenes frames": replace_by_other_layout,
    "must contain 7-Scenes frames": remove_frames,
    "color.png": break_images,
    "depth.png": break_depths,
    "depth.png: must be as large as the sequence's first image, 32x24, got 10x10": shrink_depths,
    "camera-intrinsics.txt": break_intrinsics,
}


@pytest.mark.parametrize("message", DAMAGES)
def test_unusable_data_is_refused(tmp_path, scene, message):
    DAMAGES[message](scene)
    assert_refused(run(tmp_path, "7scenes", "--data", scene, "--quiet"), message)
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--set", "tracking.iteratons=3"], "tracking.iteratons is not an option; did you mean tracking.iterations?"),
        (["--set", "tracking.iterations=0"], "tracking.iterations must be at least 1, got 0"),
        (["--set", "tracking.iterations"], "--set must be section.key=value, got tracking.iterations"),
        (["--seed", "-1"], "seed must be at least 0, got -1"),
        (["--device", "gpu"], "device must be auto, cpu, cuda or cuda:N, got 'gpu'"),
        (["--frames", "10:20"], "frames must select at least one of 0..3, got 10:20"),
        (["--set", "prior.weights=absent.safetensors"], "absent.safetensors"),
    ],
)
def test_wrong_options_are_refused(tmp_path, scene, arguments, message):
    result = spslam("run", "7scenes", "--data", scene, "--output", "out", *arguments, cwd=tmp_path)
    assert_refused(result, message)
    assert not (tmp_path / "out").exists()


def test_missing_data_option_is_refused(tmp_path):
    assert_refused(run(tmp_path, "7scenes"), "--data")


@pytest.mark.skipif(torch.cuda.is_available(), reason="the device isn't absent here")
@pytest.mark.parametrize("command", [["run", "demo"], ["demo"]])
def test_absent_device_is_refused(tmp_path, command):
    result = spslam(*command, "--device", "cuda", "--output", "out", cwd=tmp_path)
    assert_refused(result, "device cuda is not available")
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    ("name", "message"),
    [("notes.txt", "is not empty"), ("metrics.json", "holds"), ("checkpoint.safetensors", "--resume")],
)
def test_an_output_folder_in_use_is_refused_and_not_changed(tmp_path, scene, name, message):
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / name).write_text("mine")
    assert_refused(run(tmp_path, "7scenes", "--data", scene), message)
    assert [path.name for path in (tmp_path / "out").iterdir()] == [name]
    assert (tmp_path / "out" / name).read_text() == "mine"


def test_output_that_is_a_file_is_refused(tmp_path, scene):
    (tmp_path / "out").write_text("mine")
    assert_refused(run(tmp_path, "7scenes", "--data", scene), "is a file")
    assert (tmp_path / "out").read_text() == "mine"


def test_demo_does_not_replace_another_run(tmp_path):
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "config.yaml").write_text("dataset: {type: tum}\n")
    assert_refused(spslam("demo", "--output", "out", cwd=tmp_path), "holds a run over other data")
    (tmp_path / "out" / "config.yaml").write_text("something: else\n")
    assert_refused(spslam("demo", "--output", "out", cwd=tmp_path), "holds something that isn't a demo")
    assert len(list((tmp_path / "out").iterdir())) == 1


def test_demo_removes_nothing_where_something_else_is_too(tmp_path):
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "config.yaml").write_text("dataset: {type: generated}\n")
    for name in ("mesh.ply", "notes.txt"):
        (tmp_path / "out" / name).write_text("mine")
    refused = spslam("demo", "--output", "out", cwd=tmp_path)
    assert_refused(refused, "out: holds notes.txt beside an earlier demo; use another --output")
    assert len(list((tmp_path / "out").iterdir())) == 3


def test_closed_streams_are_no_error(tmp_path, monkeypatch):
    for stream in ("stdout", "stderr"):
        monkeypatch.setattr(sys, stream, None)
    assert main(["run", "absent", "--output", str(tmp_path / "out")]) == 2
    assert main(["--version-of-nothing"]) == 2


def test_arguments_that_can_not_be_meant_are_refused(tmp_path, scene):
    assert_refused(spslam("run", "", cwd=tmp_path), "an argument is the empty text")
    border = run(tmp_path, "7scenes", "--data", scene, "--set", "dataset.border_px=300")
    assert_refused(border, "dataset.border_px must leave some of images of ")
    both = ("--record", "out", "--output", "out")
    assert_refused(spslam("live", "replay", "7scenes", "--data", scene, *both, cwd=tmp_path), "must be two folders")
    inside = ("--record", "rec", "--output", "rec/out")
    refused = spslam("live", "replay", "7scenes", "--data", scene, *inside, cwd=tmp_path)
    assert_refused(refused, "--output must not be inside the folder of --record, rec, got rec/out")
    (tmp_path / "empty").mkdir()
    merged = spslam("merge", "empty", "empty", "--output", "out", cwd=tmp_path)
    assert_refused(merged, "empty: must be the output folder of a finished run, but has no config.yaml")


@pytest.mark.parametrize("command", ["eval", "mesh"])
def test_commands_on_a_finished_run_refuse_other_folders(tmp_path, command):
    assert_refused(spslam(command, "absent", cwd=tmp_path), "absent: no such folder")
    (tmp_path / "file").write_text("")
    assert_refused(spslam(command, "file", cwd=tmp_path), "must be the output folder of a run, got a file")
    (tmp_path / "empty").mkdir()
    assert_refused(spslam(command, "empty", cwd=tmp_path), "must be the output folder of a finished run, but has no ")


def test_check_data_reads_every_sequence_of_a_scene(tmp_path, scene):
    shutil.copytree(scene / "seq-01", scene / "seq-02")
    (scene / "seq-02" / "frame-000001.depth.png").write_bytes(b"")
    result = spslam("check-data", "7scenes", "--data", scene, cwd=tmp_path)
    assert result.returncode == 0
    first, second = result.stdout.split("\n\n")
    assert "seq-01" in first
    assert "seq-02" in second
    assert "! unreadable: " in second
    assert "frame-000001.depth.png: the file is empty" in second


def test_check_data_refuses_what_run_refuses(tmp_path):
    assert_refused(spslam("check-data", "7scenes", "--data", "absent", cwd=tmp_path), "absent: no such folder")
