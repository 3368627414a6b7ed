"""Runs in processes: records, resuming, failure, kill."""

import json
import os
import signal
import subprocess
import sys
import time

import pytest

from spslam.benchmark import measure as measure_module
from spslam.benchmark.records import RECORDS, RUNS, WORK, record_path, run_jobs
from spslam.benchmark.suites import GICP
from spslam.errors import OutputError
from spslam.tasks.child import execute
from spslam.tasks.local import LocalExecutor
from spslam.tasks.task import TaskCall, TaskEnd
from tests.benchmark.examples import tiny_job
from tests.cli.command import ROOT, assert_refused, spslam
from tests.tasks.examples import InThisProcess


def by_key(*jobs):
    return {job.key(): job for job in jobs}


def test_runs_leave_records_once(tmp_path):
    jobs = by_key(tiny_job(), tiny_job(GICP))
    reports = []
    outcomes = run_jobs(jobs, tmp_path, LocalExecutor(workers=2, threads=1), True, lambda *r: reports.append(r))
    assert [(done, total) for done, total, _ in reports] == [(1, 2), (2, 2)]
    for key in jobs:
        record = json.loads(record_path(tmp_path, key).read_text())
        assert record == outcomes[key].record
        assert record["figures"]["frames"] == 4
        assert record["figures"]["ate_rmse_cm"] < 5
        assert record["environment"]["runs_at_a_time"] == 2
        assert record["environment"]["kernel_threads"] == 1
    assert (tmp_path / RUNS / next(iter(jobs)) / "trajectory.txt").is_file()
    assert not list((tmp_path / WORK).glob("*"))

    before = {path: path.stat().st_mtime_ns for path in (tmp_path / RECORDS).iterdir()}
    again = run_jobs(jobs, tmp_path, LocalExecutor())
    assert all(outcome.earlier for outcome in again.values())
    assert {path: path.stat().st_mtime_ns for path in (tmp_path / RECORDS).iterdir()} == before


def test_weights_are_an_input_that_is_read_where_it_was_copied(tmp_path, monkeypatch):
    (tmp_path / "w.safetensors").write_bytes(b"trained")
    monkeypatch.chdir(tmp_path)
    job, started, measured = tiny_job(options=(("prior.weights", "w.safetensors"),)), [], []

    class Copying(InThisProcess):
        def start(self, task):
            started.append(task)
            task.output.mkdir(parents=True)
            paths = dict.fromkeys(task.inputs, "/copy/w.safetensors")
            execute(TaskCall(task.function, task.arguments, task.output, 1, 1, paths))
            self.end = TaskEnd(task.key)

    def measure(local, folder, threads):
        measured.append(local.load_config().prior.weights)
        return {"environment": {}, "figures": {}}

    monkeypatch.setattr(measure_module, "measure", measure)
    outcomes = run_jobs(by_key(job), tmp_path / "out", Copying())
    assert started[0].inputs == (str(tmp_path / "w.safetensors"),)
    assert measured == ["/copy/w.safetensors"]
    assert outcomes[job.key()].record["job"]["options"] == [["prior.weights", "w.safetensors"]]
    assert tiny_job(GICP, options=job.options).weights() is None


def test_failed_run_is_reported_and_tried_again(tmp_path):
    job = tiny_job(config="7scenes", options=(), data=str(tmp_path / "nothing"), sequence="kitchen")
    outcome = run_jobs(by_key(job), tmp_path / "out", LocalExecutor())[job.key()]
    assert outcome.record is None
    assert "nothing" in outcome.error
    assert not list((tmp_path / "out" / RECORDS).glob("*.json"))


def test_damaged_record_is_run_again(tmp_path):
    job = tiny_job(GICP)
    record_path(tmp_path, job.key()).parent.mkdir()
    record_path(tmp_path, job.key()).write_text('{"figures"')
    outcome = run_jobs(by_key(job), tmp_path, LocalExecutor())[job.key()]
    assert outcome.record is not None and not outcome.earlier


LONG = """
import sys
from pathlib import Path
from spslam.benchmark import measure as measure_module
from spslam.benchmark.records import run_jobs
from spslam.tasks.child import execute
from spslam.tasks.local import LocalExecutor
from spslam.tasks.task import TaskCall, TaskEnd
from tests.benchmark.examples import tiny_job

job = tiny_job(frames="0:3000", options=(*tiny_job().options, ("dataset.frames", 3000)))
run_jobs({job.key(): job}, Path(sys.argv[1]), LocalExecutor(threads=1))
"""


def test_kill_leaves_nothing_half_written(tmp_path):
    output, job = tmp_path / "out", tiny_job(GICP)
    process = subprocess.Popen(
        [sys.executable, "-c", LONG, str(output)], env={**os.environ, "PYTHONPATH": str(ROOT)}, cwd=tmp_path
    )
    log = wait_for(output / WORK, "*/log.jsonl")
    with pytest.raises(OutputError, match="out: another spslam bench is running in it; use another --output"):
        run_jobs(by_key(job), output, LocalExecutor())
    process.send_signal(signal.SIGKILL)
    process.wait()
    size = settled_size(log)
    time.sleep(0.5)
    assert log.stat().st_size == size, "the run continues after its parent was killed"
    assert not list((output / RECORDS).iterdir())

    assert run_jobs(by_key(job), output, LocalExecutor())[job.key()].record
    assert [path.name for path in (output / RECORDS).iterdir()] == [f"{job.key()}.json"]
    assert not list((output / WORK).glob("*"))


def wait_for(folder, pattern):
    for _ in range(1200):
        found = list(folder.glob(pattern)) if folder.exists() else []
        if found and found[0].stat().st_size:
            return found[0]
        time.sleep(0.05)
    raise AssertionError(f"no {pattern} in {folder}")


def settled_size(path):
    """The run ends as soon as it sees that its parent is gone."""
    for _ in range(100):
        size = path.stat().st_size
        time.sleep(0.2)
        if path.stat().st_size == size:
            return size
    return -1


@pytest.mark.slow
def test_the_command_prints_tables_and_writes_them(tmp_path):
    words = ("quick", "--sequences", "room", "--presets", "fast", "--frames", "0:2", "--output", "out")
    done = spslam("bench", *words, "--device", "cpu", cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    assert "spslam fast" in done.stdout and "GICP odometry, 4 cm" in done.stdout
    assert "[2/2]" in done.stderr
    assert {"results.md", "results.html", "summary.json"} <= {path.name for path in (tmp_path / "out").iterdir()}


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((), "SUITE must be one of 7scenes, ablation, places, quick"),
        (("replika",), "suite must be one of"),
        (("quick", "--data", "nowhere"), "--data must be a folder that contains the datasets, got nowhere"),
        (("quick", "--frames", "9"), "--frames must be START:STOP"),
        (("quick", "--sequences", "x"), "sequence must be one of room"),
        (("quick", "--folders", "x.yaml"), "--folders needs --data"),
        (("quick", "--data", ".", "--folders", "x.yaml"), "x.yaml: can't be read: No such file"),
    ],
)
def test_wrong_arguments_give_one_line(tmp_path, arguments, message):
    assert_refused(spslam("bench", *arguments, cwd=tmp_path), message)


def test_suites_and_runs_are_listed(tmp_path):
    suites = spslam("bench", "--list", cwd=tmp_path)
    assert "7scenes" in suites.stdout
    runs = spslam("bench", "quick", "--list", cwd=tmp_path)
    assert "room-fast-seed0-" in runs.stdout
    assert "skipped kitchen: no --data given" in runs.stdout
    assert not list(tmp_path.iterdir())


def test_nothing_to_run_is_reported(tmp_path):
    done = spslam("bench", "tum", cwd=tmp_path)
    assert done.returncode == 2
    assert "skipped fr1/desk: no --data given" in done.stderr
    assert "no run of tum is possible: no data found" in done.stderr


def test_output_that_is_a_file_is_refused(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(OutputError, match="file: can't be used for results"):
        run_jobs({}, tmp_path / "file", LocalExecutor())
