"""Interrupted runs: what they leave, and that resuming gives the bytes of an uninterrupted run."""

import json
import os
import random
import shutil
import signal
import subprocess
import sys
import time

import pytest

from spslam.config import load_config
from spslam.datasets import registry
from spslam.errors import DatasetError, OutputError
from spslam.prior.encoder import shipped_weights
from spslam.run import loop as run_loop
from spslam.run.output_folder import OutputFolder
from spslam.run.sequence import RunRequest, run_sequence
from spslam.slam.system import SlamSystem
from tests.cli.command import ROOT
from tests.system.sequences import FAST_SETTINGS, Recorded, results, run_on, settings, write_room

FRAMES = 16
# Optimizer moments that are kept from one mapping call to the next must be restored too.
OVERRIDES = ("run.checkpoint_every=2", "mapping.every=3", "mapping.reset_moments=false", "dataset.type=7scenes")

# Writes half of the third checkpoint, then kills itself with SIGKILL.
DIE_WHILE_SAVING = """
import os, signal, sys
import safetensors.torch
from spslam.cli.main import main

save, saved = safetensors.torch.save_file, []

def save_half(tensors, path, metadata=None):
    save(tensors, path, metadata=metadata)
    saved.append(path)
    if len(saved) == 3:
        os.truncate(path, os.path.getsize(path) // 2)
        os.kill(os.getpid(), signal.SIGKILL)

safetensors.torch.save_file = save_half
sys.exit(main(sys.argv[1:]))
"""


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    return write_room(tmp_path_factory.mktemp("data"), FRAMES)


@pytest.fixture(scope="module")
def uninterrupted(data, tmp_path_factory):
    output = tmp_path_factory.mktemp("runs") / "whole"
    run_sequence(RunRequest(settings(*OVERRIDES), data, output, mesh=False))
    return results(output)


def command(data, output, *arguments):
    options = [word for override in (*FAST_SETTINGS, *OVERRIDES) for word in ("--set", override)]
    return ["run", "demo", "--set", f"dataset.path={data}", "--output", str(output), "--no-mesh", *options, *arguments]


def start(*arguments, code=None):
    how = ["-m", "spslam.cli.main"] if code is None else ["-c", code]
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    pipe = subprocess.PIPE
    return subprocess.Popen([sys.executable, *how, *arguments], env=environment, stdout=pipe, stderr=pipe, text=True)


def frames_logged(output):
    """Of the complete lines: a run that goes on may have written a part of the next."""
    log = output / "log.jsonl"
    lines = log.read_text().splitlines(keepends=True) if log.exists() else []
    return [json.loads(line)["frame"] for line in lines if line.endswith("\n")]


def kill_after(process, output, frames, delay_s):
    """Kills the process a short time after this number of frames is logged."""
    deadline = time.monotonic() + 100
    while process.poll() is None and time.monotonic() < deadline:
        if output.exists() and len(frames_logged(output)) >= frames:
            time.sleep(delay_s)
            process.kill()
            break
        time.sleep(0.005)
    process.communicate()


@pytest.mark.slow
def test_run_killed_at_random_times_resumes_to_the_same_bytes(data, uninterrupted, tmp_path):
    output, chance = tmp_path / "out", random.Random(os.getpid())
    for frames in (4, 9):
        kill_after(start(*command(data, output, "--resume")), output, frames, chance.uniform(0, 0.1))
    finished = start(*command(data, output, "--resume"))
    _, errors = finished.communicate(timeout=120)
    assert finished.returncode == 0, errors
    assert results(output) == uninterrupted
    assert frames_logged(output) == list(range(FRAMES))
    assert not (output / "checkpoint.safetensors").exists()
    assert json.loads((output / "metrics.json").read_text())["frames"] == FRAMES


def test_kill_while_writing_a_checkpoint_keeps_the_one_before(data, uninterrupted, tmp_path):
    output = tmp_path / "out"
    process = start(*command(data, output), code=DIE_WHILE_SAVING)
    process.communicate(timeout=120)
    assert process.returncode == -signal.SIGKILL
    assert list(output.glob(".checkpoint.*.tmp.safetensors"))
    assert frames_logged(output) == list(range(6))
    run_sequence(RunRequest(settings(*OVERRIDES), data, output, resume=True, mesh=False))
    assert results(output) == uninterrupted
    assert frames_logged(output) == list(range(FRAMES))
    assert not list(output.glob(".*"))


class InterruptedForTestError(Exception):
    """Raised by a test in the middle of a run."""


def interrupt(monkeypatch, output, after, *overrides, error=InterruptedForTestError, dataset=None, **arguments):
    """Runs over recorded frames and raises `error` after `after` of them."""

    def progress(done, total, report):
        if done == after:
            raise error

    with pytest.raises(error):
        run_on(monkeypatch, dataset or Recorded(8), output, *overrides, progress=progress, **arguments)


@pytest.mark.parametrize(("preset", "error"), [("balanced", KeyboardInterrupt), ("paper", InterruptedForTestError)])
def test_run_resumes_to_the_same_bytes_after_an_exception(monkeypatch, tmp_path, preset, error):
    run_on(monkeypatch, Recorded(8), tmp_path / "whole", preset=preset)
    interrupt(monkeypatch, tmp_path / "out", 7, "run.checkpoint_every=4", error=error, preset=preset)
    assert frames_logged(tmp_path / "out") == list(range(7))
    run_on(monkeypatch, Recorded(8), tmp_path / "out", resume=True, preset=preset)
    assert results(tmp_path / "out") == results(tmp_path / "whole")
    assert frames_logged(tmp_path / "out") == list(range(8))


def test_skipped_frames_are_counted_once(monkeypatch, tmp_path):
    def change(frame):
        if frame.index in (2, 6):
            raise DatasetError(f"frame {frame.index} is broken")

    dataset = Recorded(8, change)
    interrupt(monkeypatch, tmp_path / "out", 7, "run.checkpoint_every=4", dataset=dataset)
    metrics = run_on(monkeypatch, dataset, tmp_path / "out", resume=True)
    assert (metrics["frames"], metrics["skipped_frames"]) == (6, 2)
    assert [json.loads(line)["index"] for line in (tmp_path / "out/log.jsonl").read_text().splitlines()] == [
        0,
        1,
        3,
        4,
        5,
        7,
    ]


def test_last_optimization_runs_after_resuming(monkeypatch, tmp_path):
    """The frames after the checkpoint can't be read, so only the checkpoint says that a mapping call is due."""

    def change(frame):
        if frame.index >= 4:
            raise DatasetError("broken")

    dataset = Recorded(8, change)
    run_on(monkeypatch, dataset, tmp_path / "whole")
    interrupt(monkeypatch, tmp_path / "out", 6, "run.checkpoint_every=4", dataset=dataset)
    run_on(monkeypatch, dataset, tmp_path / "out", resume=True)
    assert results(tmp_path / "out") == results(tmp_path / "whole")


def test_run_without_checkpoint_starts_over(monkeypatch, tmp_path):
    output = tmp_path / "out"
    interrupt(monkeypatch, output, 3)
    with pytest.raises(OutputError, match="ended before its first checkpoint; start it over with --resume"):
        run_on(monkeypatch, Recorded(8), output)
    run_on(monkeypatch, Recorded(4), output, resume=True)
    assert frames_logged(output) == list(range(4))


def test_resume_without_earlier_run_starts_a_new_one(monkeypatch, tmp_path):
    assert run_on(monkeypatch, Recorded(2), tmp_path / "out", resume=True)["frames"] == 2


def test_finished_run_is_not_changed(monkeypatch, tmp_path):
    output = tmp_path / "out"
    run_on(monkeypatch, Recorded(2), output)
    before = {path.name: path.read_bytes() for path in output.iterdir() if path.is_file()}
    with pytest.raises(OutputError, match="holds a finished run; use another --output"):
        run_on(monkeypatch, Recorded(2), output)
    run_on(monkeypatch, Recorded(2), output, resume=True)
    assert {path.name: path.read_bytes() for path in output.iterdir() if path.is_file()} == before


@pytest.fixture
def interrupted(monkeypatch, tmp_path):
    interrupt(monkeypatch, tmp_path / "out", 7, "run.checkpoint_every=4")
    return tmp_path / "out"


def test_interrupted_run_is_not_overwritten(monkeypatch, interrupted):
    with pytest.raises(
        OutputError, match="contains an interrupted run; continue it with --resume, or use another --output"
    ):
        run_on(monkeypatch, Recorded(8), interrupted)


@pytest.mark.parametrize("override", ["seed=1", "tracking.pixels=512", "scene.voxel_size_m=0.05", "dataset.stride=2"])
def test_resuming_with_other_settings_is_refused(monkeypatch, interrupted, override):
    with pytest.raises(OutputError, match="belongs to a run with other options") as error:
        run_on(monkeypatch, Recorded(8), interrupted, override, resume=True)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("override", ["run.checkpoint_every=3", "mesh.resolution_m=0.05", "scene.max_voxels=9000000"])
def test_settings_that_do_not_affect_the_result_may_change(monkeypatch, interrupted, override):
    assert run_on(monkeypatch, Recorded(8), interrupted, override, resume=True)["frames"] == 8


def test_resuming_with_other_frames_is_refused(monkeypatch, interrupted):
    with pytest.raises(OutputError, match=r"belongs to a run over other data or frames \(.*\); use another --output"):
        run_on(monkeypatch, Recorded(20), interrupted, resume=True, frames=slice(2, 10))


def test_resuming_with_another_data_folder_is_refused(monkeypatch, interrupted, tmp_path):
    monkeypatch.setattr(registry, "open_dataset", lambda *_: Recorded(8))
    with pytest.raises(OutputError, match="belongs to a run over other data"):
        run_sequence(RunRequest(settings(), tmp_path, interrupted, resume=True, mesh=False))


@pytest.mark.parametrize("size", [0, 7, 1000])
def test_damaged_checkpoint_is_one_line(monkeypatch, interrupted, size):
    checkpoint = interrupted / "checkpoint.safetensors"
    checkpoint.write_bytes(checkpoint.read_bytes()[:size])
    with pytest.raises(OutputError, match=r"checkpoint.safetensors: not a readable checkpoint \(") as error:
        run_on(monkeypatch, Recorded(8), interrupted, resume=True)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("every", "last_saved", "done", "due"),
    [(0, 0, 500, False), (100, 0, 99, False), (100, 0, 100, True), (100, 5000, 5100, False), (100, 5000, 5556, True)],
)
def test_checkpoint_interval_is_at_least_a_tenth_of_the_frames(every, last_saved, done, due):
    assert run_loop._is_checkpoint_due(every, last_saved, done) == due


def test_a_report_that_a_kill_left_out_is_written(monkeypatch, tmp_path):
    """Without a checkpoint only metrics.json says that a run is finished."""
    output = tmp_path / "out"
    monkeypatch.setattr(OutputFolder, "write_report", lambda folder: os.kill(os.getpid(), signal.SIGINT))
    with pytest.raises(KeyboardInterrupt):
        run_on(monkeypatch, Recorded(3), output, "run.previews=2")
    monkeypatch.undo()
    left = {path.name: path.read_bytes() for path in output.rglob("*") if path.is_file()}
    assert {"metrics.json", "camera.json", "frame-000000.png"} <= left.keys() and "report.html" not in left
    run_on(monkeypatch, Recorded(3), output, "run.previews=2", resume=True)
    assert (output / "report.html").is_file()
    assert all((path.read_bytes() == left[path.name]) for path in output.rglob("*") if path.name in left)


def test_ctrl_c_while_the_map_is_completed_ends_the_run(monkeypatch, tmp_path):
    finish = SlamSystem.finish

    def interrupted(system):
        os.kill(os.getpid(), signal.SIGINT)
        finish(system)

    monkeypatch.setattr(SlamSystem, "finish", interrupted)
    with pytest.raises(KeyboardInterrupt):
        run_on(monkeypatch, Recorded(4), tmp_path / "out")
    monkeypatch.setattr(SlamSystem, "finish", finish)
    assert frames_logged(tmp_path / "out") == list(range(4))
    assert not (tmp_path / "out" / "metrics.json").exists()
    run_on(monkeypatch, Recorded(4), tmp_path / "out", resume=True)
    run_on(monkeypatch, Recorded(4), tmp_path / "whole")
    assert results(tmp_path / "out") == results(tmp_path / "whole")


def test_options_that_were_saved_hold_in_any_working_directory(monkeypatch, tmp_path):
    """Weights that were named by a relative path too: `spslam merge` reads them from wherever it is called."""
    shutil.copy(shipped_weights(64), tmp_path / "own.safetensors")
    monkeypatch.chdir(tmp_path)
    metrics = run_on(monkeypatch, Recorded(2), tmp_path / "out", "prior.weights=own.safetensors")
    assert load_config(tmp_path / "out" / "config.yaml").prior.weights == str(tmp_path / "own.safetensors")
    again = run_on(monkeypatch, Recorded(2), tmp_path / "out", "prior.weights=own.safetensors", resume=True)
    assert again == metrics
