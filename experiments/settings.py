"""Accuracy of settings: runs each one over each sequence with several seeds, in parallel, and prints one table.

    python -m experiments.settings --sequence kitchen=7scenes:path/to/redkitchen:0:300 --sequence room=demo::0:150 \
        --setting balanced --setting balanced,mapping.every=3 --seeds 3 --workers 4 --jsonl settings.jsonl

A sequence is NAME=CONFIG:FOLDER:START:STOP[:STEP] and optional ,KEY=VALUE of its own; a setting is PRESET,KEY=VALUE,...
Workers are processes with `--threads` kernel threads each; with `--device cuda` they are distributed over all GPUs. A
row is written when its run has finished. Rows that the file already has are not run again, so an interrupted call can
be continued.
"""

import argparse
import json
import os
import queue
import statistics
import subprocess
import sys
import threading
import time
from collections.abc import Iterable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch

from experiments.arguments import make_parser
from spslam import ops
from spslam.benchmark.environment import describe_environment
from spslam.config import Config, load_config
from spslam.datasets import open_dataset
from spslam.datasets.base import Subset
from spslam.errors import DatasetError
from spslam.evaluation.trajectory_metrics import ate, rpe
from spslam.run.device import resolve_device
from spslam.run.frame_feed import FrameFeed
from spslam.run.warm_up import warm_up
from spslam.slam.system import SlamSystem

FIGURES = ("ate_rmse_cm", "rpe_cm", "rpe_deg", "lost", "fps")


@dataclass(frozen=True)
class Job:
    """One sequence with one setting and seed; `overrides` are options of the sequence."""

    name: str
    config: str
    folder: str
    start: int
    stop: int | None
    step: int
    overrides: tuple[str, ...]
    setting: str
    seed: int

    @property
    def key(self) -> tuple[str, str, int]:
        """Identifies a row of results."""
        return self.setting, self.name, self.seed

    def load_config(self, threads: int) -> Config:
        """All options of the run; raises ConfigError."""
        preset, *overrides = self.setting.split(",")
        own = [f"seed={self.seed}", f"run.prefetch_workers={threads}", *self.overrides]
        return load_config(self.config, preset, [*own, *overrides])


def main() -> None:
    """Parses the arguments; runs the jobs in worker processes, or is such a worker."""
    args = _parser().parse_args()
    if args.worker:
        serve(args.device, args.threads)
        return
    settings = args.setting + [line for path in args.settings for line in read_settings(path)]
    # Seeds outermost: an interrupted call has some seeds of all settings rather than all seeds of some.
    jobs = [parse_job(q, setting, seed) for seed in range(args.seeds) for setting in settings for q in args.sequence]
    rows = read_rows(args.jsonl) if args.jsonl else []
    done = {(row["setting"], row["name"], row["seed"]) for row in rows if "error" not in row}
    rows += run_jobs([job for job in jobs if job.key not in done], args)
    print_table(rows)


def _parser() -> argparse.ArgumentParser:
    parser = make_parser(__doc__)
    parser.add_argument("--sequence", action="append", default=[])
    parser.add_argument("--setting", action="append", default=[])
    parser.add_argument("--settings", action="append", default=[], type=Path, help="file with one setting per line")
    parser.add_argument("--seeds", type=int, default=1, help="runs of each, with seeds from 0 on")
    parser.add_argument("--device", default="cpu", help="cpu or cuda")
    parser.add_argument("--workers", type=int, default=1, help="simultaneous runs, on all devices together")
    parser.add_argument("--threads", type=int, default=2, help="kernel and reading threads of a run")
    parser.add_argument("--jsonl", type=Path, help="file to append one line per run to")
    parser.add_argument("--worker", action="store_true", help=argparse.SUPPRESS)
    return parser


def parse_job(sequence: str, setting: str, seed: int) -> Job:
    """The job of NAME=CONFIG:FOLDER:START:STOP[:STEP][,KEY=VALUE...] and PRESET,KEY=VALUE,..."""
    place, *overrides = sequence.split(",")
    name, _, rest = place.partition("=")
    config, folder, start, stop, *step = rest.split(":")
    bounds = int(start or 0), int(stop) if stop else None, int(step[0]) if step else 1
    return Job(name, config, folder, *bounds, tuple(overrides), setting, seed)


def read_settings(path: Path) -> list[str]:
    """The lines of a file that are neither empty nor comments."""
    lines = (line.strip() for line in path.read_text(encoding="utf-8").splitlines())
    return [line for line in lines if line and not line.startswith("#")]


def read_rows(path: Path) -> list[dict[str, Any]]:
    """Rows of earlier runs; empty where there is no file."""
    return [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines()] if path.exists() else []


def run_jobs(jobs: list[Job], args: argparse.Namespace) -> list[dict[str, Any]]:
    """Rows of the jobs in the order in which they finish; each is written at once."""
    waiting: queue.SimpleQueue[Job] = queue.SimpleQueue()
    results: queue.SimpleQueue[dict[str, Any]] = queue.SimpleQueue()
    for job in jobs:
        waiting.put(job)
    for number in range(min(args.workers, len(jobs))):
        threading.Thread(target=drive_worker, args=(number, args, waiting, results), daemon=True).start()
    rows = []
    for _ in jobs:
        rows.append(results.get())
        if args.jsonl:
            with args.jsonl.open("a", encoding="utf-8") as file:
                file.write(json.dumps(rows[-1]) + "\n")
    return rows


def drive_worker(number: int, args: argparse.Namespace, waiting: queue.SimpleQueue, results: queue.SimpleQueue) -> None:
    """Sends jobs to a worker process one by one; a job that crashes the worker is a row with an error."""
    process = None
    while True:
        try:
            job = waiting.get_nowait()
        except queue.Empty:
            break
        if process is None or process.poll() is not None:
            process = start_worker(number, args)
        process.stdin.write(json.dumps(asdict(job)) + "\n")
        process.stdin.flush()
        answer = process.stdout.readline()
        if answer:
            results.put(json.loads(answer))
        else:
            results.put({**asdict(job), "error": f"the worker ended with code {process.wait()}"})
    if process is not None:
        process.stdin.close()


def start_worker(number: int, args: argparse.Namespace) -> subprocess.Popen:
    """Starts a worker process, which reads jobs from its standard input; on CUDA it uses one GPU."""
    environment = dict(os.environ)
    if args.device == "cuda":
        gpus = os.environ.get("CUDA_VISIBLE_DEVICES") or ",".join(map(str, range(torch.cuda.device_count())))
        environment["CUDA_VISIBLE_DEVICES"] = gpus.split(",")[number % len(gpus.split(","))]
    command = [sys.executable, "-m", "experiments.settings", "--worker", "--device", args.device]
    command += ["--threads", str(args.threads)]
    return subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=environment)


def serve(device_name: str, threads: int) -> None:
    """Main loop of a worker: reads jobs from standard input, writes rows to standard output."""
    torch.set_num_threads(1)
    ops.set_num_threads(threads)
    device = resolve_device(device_name)
    for line in sys.stdin:
        fields = json.loads(line)
        job = Job(**{**fields, "overrides": tuple(fields["overrides"])})
        try:
            row = run_job(job, device, threads)
        except Exception as error:
            row = {**asdict(job), "error": f"{type(error).__name__}: {error}"}
        print(json.dumps(row), flush=True)


def run_job(job: Job, device: torch.device, threads: int) -> dict[str, Any]:
    """Tracks and maps what can be read of the sequence; returns ATE, RPE, lost and recovered frames, and frames/s."""
    config = job.load_config(threads)
    dataset = Subset(open_dataset(config.dataset, job.folder or None), job.start, job.stop, job.step)
    ground_truth = dataset.poses()
    warm_up(config, dataset.camera, device)
    system = SlamSystem(config, dataset.camera, ground_truth[0], device)
    reports, read, started = [], [], time.perf_counter()
    with FrameFeed(dataset, config, device) as feed:
        for position, frame in enumerate(feed):
            if not isinstance(frame, DatasetError):
                read.append(position)
                reports.append(system.submit(frame))
    system.finish()
    recovered = sum(report.result().recovered for report in reports)
    fps = len(read) / (time.perf_counter() - started)
    estimated = system.trajectory()
    known = estimated.mask_lost(ground_truth[read])
    figures = {**ate(estimated.poses, known), **rpe(estimated.poses, known)}
    counts = {"frames": len(read), "lost": int(estimated.lost.sum()), "recovered": recovered, "fps": fps}
    environment = describe_environment(device)
    return {**asdict(job), **figures, **counts, **{k: environment[k] for k in ("device_name", "torch", "commit")}}


def print_table(rows: Iterable[dict[str, Any]]) -> None:
    """Prints means over the seeds and the range of the ATE; one line per setting and sequence."""
    groups: dict[tuple[str, str], list[dict[str, Any]]] = {}
    for row in rows:
        groups.setdefault((row["setting"], row["name"]), []).append(row)
    print(f"{'setting':70s} {'sequence':12s}  runs  ATE cm spread  RPE cm RPE deg   lost    fps")
    for (setting, name), group in sorted(groups.items()):
        head = f"{setting:70s} {name:12s}"
        good = [row for row in group if "error" not in row]
        for error in {row["error"] for row in group if "error" in row}:
            print(head, error)
        if good:
            means = [statistics.mean(row[figure] for row in good) for figure in FIGURES]
            ates = [row["ate_rmse_cm"] for row in good]
            print(f"{head} {len(good):5d} {means[0]:7.3f} {max(ates) - min(ates):6.3f}", end=" ")
            print(f"{means[1]:7.3f} {means[2]:7.3f} {means[3]:6.1f} {means[4]:6.1f}")


if __name__ == "__main__":
    main()
