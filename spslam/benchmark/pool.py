"""Runs in parallel processes, one per GPU where there are several; each writes its record atomically when finished."""

from __future__ import annotations

import contextlib
import fcntl
import json
import os
import queue
import shutil
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch

import spslam
from spslam.benchmark.jobs import Job
from spslam.errors import OutputError
from spslam.io import atomic_write

RECORDS, WORK, RUNS, LOCK = "records", "work", "runs", ".lock"


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


@dataclass(frozen=True)
class PoolOptions:
    """How the runs share the machine.

    Attributes:
        workers: number of simultaneous runs; None for one per GPU, or one on a machine without GPU. Timings are only
            comparable if runs don't share a device, so each record says how many there were.
        threads: kernel threads of each run; None for an equal share of the processors.
        keep: keep each run's output folder, in `runs/`.
    """

    workers: int | None = None
    threads: int | None = None
    keep: bool = False


def run_jobs(
    jobs: dict[str, Job], output: Path, options: PoolOptions, report: Report | None = None
) -> dict[str, Outcome]:
    """Runs the jobs that have no record yet.

    Args:
        jobs: by key.
        output: folder of the benchmark; `records/KEY.json` are the records of finished runs.
        options: how the runs share the machine.
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
        missing = {key: job for key, job in jobs.items() if key not in outcomes}
        for outcome in _run_missing(missing, output, options):
            outcomes[outcome.key] = outcome
            if report:
                report(len(outcomes), len(jobs), outcome)
    return outcomes


def record_path(output: Path, key: str) -> Path:
    """File of a finished run's record."""
    return output / RECORDS / f"{key}.json"


def run_here(job: Job, key: str, output: Path, workers: int, threads: int, keep: bool) -> None:
    """Runs a job in this process and writes its record; called in the processes that `run_jobs` starts.

    Args:
        job: what to run.
        key: of the job.
        output: folder of the benchmark.
        workers: number of simultaneous runs, for the record.
        threads: number of kernel threads.
        keep: move the run's output folder to `runs/KEY` instead of removing it.
    """
    from spslam.benchmark.measure import measure

    folder = output / WORK / key
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    record = measure(job, folder, threads)
    record["environment"]["runs_at_a_time"] = workers
    if keep:
        kept = output / RUNS / key
        shutil.rmtree(kept, ignore_errors=True)
        kept.parent.mkdir(exist_ok=True)
        os.replace(folder, kept)
    shutil.rmtree(folder, ignore_errors=True)
    atomic_write(record_path(output, key), json.dumps(record, indent=1) + "\n")


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


def _run_missing(jobs: dict[str, Job], output: Path, options: PoolOptions) -> Iterator[Outcome]:
    """Yields outcomes as runs finish; when left early, also by Ctrl-C, the runs in progress are killed."""
    if not jobs:
        return
    slots = _slots(options, any(job.device == "cuda" for job in jobs.values()))
    free: queue.Queue[dict[str, str]] = queue.Queue()
    for slot in slots:
        free.put(slot)
    running = _Running()
    pool = ThreadPoolExecutor(len(slots))

    def run(key: str, job: Job) -> Outcome:
        slot = free.get()
        try:
            error = running.call(_command(key, job, output, options, len(slots)), {**os.environ, **slot})
        finally:
            free.put(slot)
        return (None if error else _finished(output, key, job)) or Outcome(key, job, None, error)

    try:
        futures = [pool.submit(run, key, job) for key, job in jobs.items()]
        for future in as_completed(futures):
            outcome = future.result()
            yield replace(outcome, earlier=False)
    finally:
        running.stop()
        pool.shutdown(cancel_futures=True)


def _command(key: str, job: Job, output: Path, options: PoolOptions, workers: int) -> list[str]:
    threads = options.threads or max(1, (os.cpu_count() or 1) // workers)
    command = [sys.executable, "-m", "spslam.cli.main", "bench", "--job", job.to_json(), "--key", key]
    command += ["--output", str(output), "--workers", str(workers), "--threads", str(threads)]
    return [*command, "--keep"] if options.keep else command


def _slots(options: PoolOptions, cuda: bool) -> list[dict[str, str]]:
    """Environment variables of each simultaneous run: its GPU, and where spslam is imported from."""
    visible = os.environ.get("CUDA_VISIBLE_DEVICES")
    gpus = visible.split(",") if visible else [str(index) for index in range(torch.cuda.device_count())]
    workers = options.workers or (max(len(gpus), 1) if cuda else 1)
    paths = [str(Path(spslam.__file__).parent.parent), *os.environ.get("PYTHONPATH", "").split(os.pathsep)]
    # Spinning OpenMP threads of small_gicp would take cores from the reading threads.
    common = {"OMP_WAIT_POLICY": "passive", "PYTHONPATH": os.pathsep.join(path for path in paths if path)}
    return [
        {**common, "CUDA_VISIBLE_DEVICES": gpus[worker % len(gpus)]} if cuda and gpus else common
        for worker in range(workers)
    ]


class _Running:
    """The processes of runs in progress, which can be killed together."""

    def __init__(self) -> None:
        self._processes: set[subprocess.Popen] = set()
        self._lock = threading.Lock()
        self._stopped = False

    def call(self, command: list[str], environment: dict[str, str]) -> str:
        """Runs a command; returns one line about what went wrong, empty if nothing did."""
        with self._lock:
            if self._stopped:
                return "interrupted before it began"
            # The process ends when its standard input is closed, which happens at the latest when this process ends.
            process = subprocess.Popen(
                command, env=environment, stdin=subprocess.PIPE, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE
            )
            self._processes.add(process)
        try:
            errors = process.stderr.read().decode(errors="replace") if process.stderr else ""
            code = process.wait()
        finally:
            with self._lock:
                self._processes.discard(process)
            for stream in (process.stdin, process.stderr):
                if stream:
                    stream.close()
        if code == 0:
            return ""
        lines = errors.strip().splitlines()
        return lines[-1].removeprefix("spslam: ") if code > 0 and lines else f"ended by signal {-code}"

    def stop(self) -> None:
        """Kills all processes and prevents new ones."""
        with self._lock:
            self._stopped = True
            for process in self._processes:
                process.kill()
