"""The output folder of a run: one run at a time, what a finished one is resumed to, what a killed one leaves."""

import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest

from spslam.config import load_config
from spslam.errors import DatasetError, OutputError
from spslam.run.output_folder import OutputFolder, RunLog
from tests.cli.command import ROOT
from tests.system.sequences import Recorded, run_on
from tests.system.test_resume import interrupt

# Holds the lock of a folder until its standard input ends.
HOLDER = """
import sys
from pathlib import Path
from spslam.run.output_folder import OutputFolder
with OutputFolder(Path(sys.argv[1])).locked():
    print("locked", flush=True)
    sys.stdin.read()
"""


@pytest.fixture
def busy(tmp_path):
    """A folder that another process is writing into, and that process."""
    folder = tmp_path / "out"
    process = subprocess.Popen(
        [sys.executable, "-c", HOLDER, str(folder)], cwd=ROOT, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    )
    assert process.stdout.readline() == "locked\n"
    yield folder, process
    process.kill()
    process.wait()


@pytest.mark.parametrize("resume", [False, True])
def test_two_runs_do_not_share_a_folder(monkeypatch, busy, resume):
    folder, process = busy
    with pytest.raises(OutputError, match="another run is writing into it; wait for its end, or use another --output"):
        run_on(monkeypatch, Recorded(2), folder, resume=resume)
    assert list(folder.iterdir()) == []
    process.kill()  # the lock goes with the process
    process.wait()
    assert run_on(monkeypatch, Recorded(2), folder, resume=resume)["frames"] == 2


def test_a_file_is_no_folder(tmp_path):
    (tmp_path / "out").touch()
    with (
        pytest.raises(OutputError, match="out: is a file, not a folder for results"),
        OutputFolder(tmp_path / "out").locked(),
    ):
        pass


def test_resuming_a_finished_run_returns_its_metrics(monkeypatch, tmp_path):
    metrics = run_on(monkeypatch, Recorded(3), tmp_path / "out")
    before = {path: path.stat().st_mtime_ns for path in (tmp_path / "out").iterdir()}
    again = run_on(monkeypatch, Recorded(3), tmp_path / "out", resume=True)
    assert again == json.loads(json.dumps(metrics))
    assert {path: path.stat().st_mtime_ns for path in (tmp_path / "out").iterdir()} == before


def test_a_finished_run_of_other_options_or_frames_is_not_resumed(monkeypatch, tmp_path):
    run_on(monkeypatch, Recorded(3), tmp_path / "out")
    other = "holds a finished run of other options, data or frames; use another --output"
    with pytest.raises(OutputError, match=other):
        run_on(monkeypatch, Recorded(4), tmp_path / "out", resume=True)
    with pytest.raises(OutputError, match=other):
        run_on(monkeypatch, Recorded(3), tmp_path / "out", "seed=1", resume=True)
    (tmp_path / "out" / "metrics.json").write_text("{")
    with pytest.raises(OutputError, match=other):
        run_on(monkeypatch, Recorded(3), tmp_path / "out", resume=True)


@pytest.mark.parametrize("depth", [0.0, float("nan")])
def test_a_run_without_a_known_pose_is_an_error(monkeypatch, tmp_path, depth):
    def blank(frame):
        frame.depth[:] = depth

    with pytest.raises(DatasetError, match=r"all frames are lost: none shows a surface between dataset\.min_depth"):
        run_on(monkeypatch, Recorded(3, change=blank), tmp_path / "out")
    assert not (tmp_path / "out" / "metrics.json").exists()
    assert not (tmp_path / "out" / "map.safetensors").exists()


def test_temporary_files_of_a_killed_run_are_removed(tmp_path):
    folder = OutputFolder(tmp_path)
    folder.previews.mkdir()
    names = [".report.12.tmp.html", ".mesh.12.tmp.ply", ".log.12.tmp.jsonl", "previews/.frame-000000.12.tmp.png"]
    for name in [*names, "notes.tmp.txt"]:
        (tmp_path / name).touch()
    folder.remove_temporaries()
    assert [path.name for path in tmp_path.rglob("*") if ".tmp." in path.name] == ["notes.tmp.txt"]


def test_a_log_that_cannot_be_written_is_named():
    log = RunLog(Path("/dev/full"))
    with pytest.raises(OutputError, match="/dev/full: can't be written: No space left on device"), log:
        log.append({"frame": 0})


def test_another_camera_or_scale_of_depth_is_other_data(monkeypatch, tmp_path):
    whole = Recorded(6)
    interrupt(monkeypatch, tmp_path / "out", 5, "run.checkpoint_every=2", dataset=whole)

    def half(frame):
        frame.depth = 0.5 * frame.depth

    with pytest.raises(OutputError, match=r"belongs to a run over other data or frames \(first frame changed\)"):
        run_on(monkeypatch, Recorded(6, half), tmp_path / "out", "run.checkpoint_every=2", resume=True)
    other = Recorded(6)
    other.camera = replace(other.camera, fx=other.camera.fx + 1)
    with pytest.raises(OutputError, match=r"belongs to a run over other data or frames \(camera changed\)"):
        run_on(monkeypatch, other, tmp_path / "out", "run.checkpoint_every=2", resume=True)
    run_on(monkeypatch, whole, tmp_path / "out", "run.checkpoint_every=2", resume=True)


def test_results_of_another_run_are_not_started_over(monkeypatch, tmp_path):
    output = tmp_path / "out"
    run_on(monkeypatch, Recorded(3), output, "run.previews=2")
    for name in ("metrics.json", "report.html"):  # as after a kill near the end
        (output / name).unlink()
    with pytest.raises(OutputError, match="holds results of a run with other options or data"):
        run_on(monkeypatch, Recorded(3), output, "tracking.iterations=5", resume=True)
    assert (output / "trajectory.txt").is_file()
    run_on(monkeypatch, Recorded(4), output, "run.previews=0", resume=True)
    assert not (output / "previews" / "frame-000000.png").exists()


@pytest.mark.parametrize("change", ["shorter", "damaged"])
def test_a_log_that_does_not_fit_its_checkpoint_is_named(monkeypatch, tmp_path, change):
    output = tmp_path / "out"
    interrupt(monkeypatch, output, 5, "run.checkpoint_every=2", dataset=Recorded(6))
    lines = (output / "log.jsonl").read_text().splitlines(keepends=True)
    lines = lines[:1] if change == "shorter" else ["{broken\n", *lines[1:]]
    (output / "log.jsonl").write_text("".join(lines))
    message = r"log.jsonl: must have a line for each of the \d frames" if change == "shorter" else "log.jsonl: damaged"
    with pytest.raises(OutputError, match=message):
        run_on(monkeypatch, Recorded(6), output, "run.checkpoint_every=2", resume=True)


def test_options_of_outputs_may_change_when_a_run_is_resumed(monkeypatch, tmp_path):
    output = tmp_path / "out"
    interrupt(monkeypatch, output, 5, "run.checkpoint_every=2", dataset=Recorded(6))
    (output / "config.yaml").unlink()
    run_on(monkeypatch, Recorded(6), output, "run.checkpoint_every=2", "mesh.resolution_m=0.05", resume=True)
    assert load_config(output / "config.yaml").mesh.resolution_m == 0.05
