"""One run in this process: spslam or a baseline over a sequence, evaluated against ground truth."""

from __future__ import annotations

import json
import shutil
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

from spslam import ops
from spslam.benchmark.environment import describe_environment
from spslam.benchmark.jobs import Job
from spslam.benchmark.measure_baseline import measure_gicp, measure_orb_slam3
from spslam.benchmark.records import RECORD
from spslam.benchmark.suites import GICP, ORB_SLAM3
from spslam.datasets import open_dataset
from spslam.datasets.base import RgbdDataset
from spslam.evaluation.finished_run import NOVEL_VIEWS, surface_figures, view_figures
from spslam.evaluation.mesh_metrics import SAMPLES
from spslam.evaluation.run_output import RunOutput
from spslam.evaluation.surface import Surface, TriangleSurface
from spslam.io import atomic_write
from spslam.run.device import resolve_device
from spslam.run.request import parse_frames
from spslam.run.sequence import RunRequest, run_sequence
from spslam.tasks.task import TaskCall


def run_job(call: TaskCall) -> None:
    """The task of a job: runs it and writes its record; called in the processes of `run_jobs`.

    Args:
        call: `job` as text, `keep`, whether the run's other files are kept in the folder, and `weights`, the file of
            `prior.weights` by its absolute path, or None.

    Raises:
        SpslamError: as `measure`.
    """
    job, folder = Job.from_json(call.arguments["job"]), call.output
    _empty(folder)  # of an attempt that was killed
    here = replace(job, data=call.local(job.data), mesh=call.local(job.mesh))
    if (weights := call.local(call.arguments["weights"])) is not None:
        here = replace(here, options=(*here.options, ("prior.weights", weights)))
    record = measure(here, folder, call.threads)
    record["job"] = vars(job)
    record["environment"]["runs_at_a_time"] = call.simultaneous
    if not call.arguments["keep"]:
        _empty(folder)
    atomic_write(folder / RECORD, json.dumps(record) + "\n")


def _empty(folder: Path) -> None:
    for each in folder.iterdir():
        shutil.rmtree(each) if each.is_dir() else each.unlink()


def measure(job: Job, folder: Path, threads: int | None) -> dict[str, Any]:
    """Runs a job.

    Args:
        job: what to run.
        folder: for the run's output; must be empty.
        threads: number of kernel threads; None for one per processor.

    Returns:
        The run's record: `job`, `environment`, `figures` by their names in metrics.json, and `seconds` in total,
        evaluation included.

    Raises:
        SpslamError: something is wrong with the data or the options.
    """
    if threads is not None:
        ops.set_num_threads(threads)
    started = time.perf_counter()
    figures = _measure(job, folder, threads)
    return {
        "job": vars(job),
        "environment": describe_environment(resolve_device(job.device)),
        "figures": {name: value for name, value in figures.items() if isinstance(value, (int, float))},
        "seconds": time.perf_counter() - started,
    }


def _measure(job: Job, folder: Path, threads: int | None) -> dict[str, Any]:
    if job.method == GICP:
        return measure_gicp(job, threads or 1)
    return measure_orb_slam3(job) if job.method == ORB_SLAM3 else _measure_spslam(job, folder)


def _measure_spslam(job: Job, folder: Path) -> dict[str, Any]:
    config = job.load_config()
    data = None if job.data is None else Path(job.data)
    dataset = open_dataset(config.dataset, data)
    ground_truth = _true_surface(dataset, job.mesh)
    with_mesh = ground_truth is not None or job.thorough
    frames = None if job.frames is None else parse_frames(job.frames)
    figures = run_sequence(RunRequest(config, data, folder, frames, mesh=with_mesh))
    if "peak_gpu_mb" in figures:
        figures["peak_gpu_gb"] = figures["peak_gpu_mb"] / 1024
    run = RunOutput.read(folder)
    if run.mesh() is None:
        # A run whose camera was always lost has an empty mesh; its other figures still count.
        return figures
    if ground_truth is not None:
        extent = (SAMPLES, NOVEL_VIEWS) if job.thorough else (SAMPLES // 5, 0)
        figures |= surface_figures(run, dataset, ground_truth, *extent)
    return {**figures, **view_figures(run, dataset)} if job.thorough else figures


def _true_surface(dataset: RgbdDataset, mesh: str | None) -> Surface | None:
    if dataset.surface is not None:
        return dataset.surface
    return None if mesh is None else TriangleSurface.load(Path(mesh))
