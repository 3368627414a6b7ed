"""Accuracy of settings: runs each over each sequence, several at a time, and prints one table.

    python -m benchmarks.settings --sequence kitchen=7scenes:path/to/redkitchen:0:300 --sequence room=demo::0:150 \
        --setting balanced --setting balanced,mapping.pose_rate=1e-3 --workers 4 --json settings.json

A sequence is NAME=CONFIG:FOLDER:START:STOP, a setting PRESET,KEY=VALUE,...; each worker has `--threads` kernel threads.
"""

import argparse
import json
import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass

import torch

from spslam import ops
from spslam.benchmark.environment import describe_environment
from spslam.config import load_config
from spslam.datasets import open_dataset
from spslam.datasets.base import Subset
from spslam.evaluation.trajectory import ate, rpe
from spslam.slam.system import SlamSystem


@dataclass(frozen=True)
class Job:
    """One sequence with one setting."""

    name: str
    config: str
    folder: str
    start: int
    stop: int
    setting: str


def main() -> None:
    """Parses the arguments; runs the jobs in processes of their own, or the single one of `--job`."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sequence", action="append", default=[])
    parser.add_argument("--setting", action="append", default=[])
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--json")
    parser.add_argument("--job", help=argparse.SUPPRESS)
    args = parser.parse_args()
    if args.job:
        print(json.dumps(run_job(Job(**json.loads(args.job)), args.threads)))
        return
    jobs = [parse_job(sequence, setting) for setting in args.setting for sequence in args.sequence]
    with ThreadPoolExecutor(args.workers) as pool:
        rows = list(pool.map(lambda job: in_own_process(job, args.threads), jobs))
    print_table(rows)
    if args.json:
        with open(args.json, "w", encoding="utf-8") as file:
            json.dump({**describe_environment(torch.device("cpu")), "rows": rows}, file, indent=1)


def parse_job(sequence: str, setting: str) -> Job:
    """The job of NAME=CONFIG:FOLDER:START:STOP and PRESET,KEY=VALUE,..."""
    name, _, rest = sequence.partition("=")
    config, folder, start, stop = rest.split(":")
    return Job(name, config, folder, int(start), int(stop), setting)


def in_own_process(job: Job, threads: int) -> dict:
    """Runs a job in a process, so that several share nothing; a failure is a row with its last line."""
    command = [sys.executable, "-m", "benchmarks.settings", "--threads", str(threads), "--job", json.dumps(asdict(job))]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        return {**asdict(job), "error": done.stderr.strip().splitlines()[-1:]}
    return json.loads(done.stdout.splitlines()[-1])


def run_job(job: Job, threads: int) -> dict:
    """Tracks and maps the sequence; returns ATE, RPE and time."""
    torch.set_num_threads(1)
    ops.set_num_threads(threads)
    preset, *overrides = job.setting.split(",")
    config = load_config(job.config, preset, overrides)
    dataset = Subset(open_dataset(config.dataset, job.folder or None), job.start, job.stop)
    truth = dataset.poses()
    system = SlamSystem(config, dataset.camera, truth[0])
    started = time.perf_counter()
    for frame in dataset:
        system.process(frame)
    system.finish()
    estimated = system.trajectory()
    figures = {**ate(estimated.poses, truth), **rpe(estimated.poses, truth)}
    seconds = time.perf_counter() - started
    return {**asdict(job), **figures, "lost": int(estimated.lost.sum()), "seconds": seconds}


def print_table(rows: list[dict]) -> None:
    """One line a job."""
    print(f"{'setting':60s} {'sequence':12s} {'ATE cm':>7s} {'RPE cm':>7s} {'RPE deg':>7s} {'lost':>5s} {'s':>6s}")
    for row in rows:
        head = f"{row['setting']:60s} {row['name']:12s}"
        if "error" in row:
            print(head, *row["error"])
            continue
        figures = (row["ate_rmse_cm"], row["rpe_cm"], row["rpe_deg"])
        print(head, *(f"{value:7.3f}" for value in figures), f"{row['lost']:5d} {row['seconds']:6.1f}")


if __name__ == "__main__":
    main()
