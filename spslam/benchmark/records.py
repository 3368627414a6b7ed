"""The runs of a plan as tasks: each leaves a record, by which an interrupted benchmark goes on."""

from __future__ import annotations

import contextlib
import fcntl
import json
import os
import shutil
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from spslam.benchmark.jobs import Job
from spslam.errors import OutputError
from spslam.io import atomic_write
from spslam.run.request import memory_needed_mb
from spslam.tasks.schedule import LOG, run_tasks
from spslam.tasks.task import Executor, Needs, Task

RECORDS, WORK, RUNS, LOCK = "records", "work", "runs", ".lock"
RECORD = "record.json"  # of a run that has just finished, in its folder


@dataclass(frozen=True)
class Outcome:
    """What became of a job.

    Attributes:
        key: of the job.
        job: what was run.
        record: as `measure` returns it; None where the run failed.
        error: why it failed, in one line.
        earlier: whether an earlier call had run it.
    """

    key: str
    job: Job
    record: dict[str, Any] | None
    error: str = ""
    earlier: bool = False


Report = Callable[[int, int, Outcome], None]


def run_jobs(
    jobs: dict[str, Job], output: Path, executor: Executor, keep: bool = False, report: Report | None = None
) -> dict[str, Outcome]:
    """Runs the jobs that have no record yet.

    Args:
        jobs: by key.
        output: folder of the benchmark; `records/KEY.json` are the records of finished runs.
        executor: where they are run. Timings are only comparable if runs don't share a device, so each record says how
            many there may have been at a time.
        keep: keep each run's output folder, in `runs/`.
        report: called from this thread with (runs done, total runs, outcome).

    Returns:
        The outcome of every job by key.

    Raises:
        OutputError: the folder can't be used, or another benchmark is running in it. A failed run doesn't raise.
    """
    with _locked(output):
        _remove_leftovers(output)
        outcomes = {key: outcome for key, job in jobs.items() if (outcome := _finished(output, key, job))}
        for done, outcome in enumerate(outcomes.values(), 1):
            if report:
                report(done, len(jobs), outcome)
        tasks = [_task(job, key, output, keep) for key, job in jobs.items() if key not in outcomes]
        with contextlib.closing(run_tasks(tasks, executor, output / LOG)) as ends:
            for end in ends:
                outcome = Outcome(end.key, jobs[end.key], None, end.error)
                if not end.error:
                    outcome = Outcome(end.key, jobs[end.key], _collected(output, end.key, keep))
                outcomes[end.key] = outcome
                if report:
                    report(len(outcomes), len(jobs), outcome)
    return outcomes


def record_path(output: Path, key: str) -> Path:
    """File of a finished run's record."""
    return output / RECORDS / f"{key}.json"


@contextlib.contextmanager
def _locked(output: Path) -> Iterator[None]:
    """Locks the folder for this process; the system releases the lock when the process ends, for whatever reason."""
    try:
        (output / RECORDS).mkdir(parents=True, exist_ok=True)
        lock = (output / LOCK).open("w")
    except OSError as error:
        raise OutputError(f"{output}: can't be used for results: {error.strerror or error}") from error
    with lock:
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            raise OutputError(f"{output}: another spslam bench is running in it; use another --output") from None
        yield


def _remove_leftovers(output: Path) -> None:
    """Removes the files of runs that were in progress in a killed benchmark."""
    shutil.rmtree(output / WORK, ignore_errors=True)
    for temporary in (output / RECORDS).glob(".*.tmp.json"):
        temporary.unlink(missing_ok=True)


def _finished(output: Path, key: str, job: Job) -> Outcome | None:
    try:
        return Outcome(key, job, json.loads(record_path(output, key).read_text(encoding="utf-8")), earlier=True)
    except (OSError, ValueError):
        return None


def _task(job: Job, key: str, output: Path, keep: bool) -> Task:
    needs = Needs(gpus=int(job.device == "cuda"), memory_mb=memory_needed_mb(job.load_config(), mesh=True))
    weights = job.weights()
    inputs = tuple(path for path in (job.data, job.mesh, weights) if path is not None)
    arguments = {"job": job.to_json(), "keep": keep, "weights": weights}
    return Task(key, "spslam.benchmark.measure:run_job", arguments, output / WORK / key, needs, inputs)


def _collected(output: Path, key: str, keep: bool) -> dict[str, Any]:
    """The record of a run that has finished; its folder is kept or removed."""
    folder = output / WORK / key
    record = json.loads((folder / RECORD).read_text(encoding="utf-8"))
    (folder / RECORD).unlink()
    if keep:
        kept = output / RUNS / key
        shutil.rmtree(kept, ignore_errors=True)
        kept.parent.mkdir(exist_ok=True)
        os.replace(folder, kept)
    shutil.rmtree(folder, ignore_errors=True)
    atomic_write(record_path(output, key), json.dumps(record, indent=1) + "\n")
    return record
