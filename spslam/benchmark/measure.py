"""One run in this process: spslam or the baseline over a sequence, evaluated against ground truth."""

from __future__ import annotations

import resource
import time
from pathlib import Path
from typing import Any

import numpy as np
import torch

from spslam import ops
from spslam.benchmark.environment import describe_environment
from spslam.benchmark.gicp import GicpOdometry
from spslam.benchmark.jobs import Job
from spslam.benchmark.suites import GICP
from spslam.datasets import open_dataset, open_sequence
from spslam.datasets.base import RgbdDataset
from spslam.datasets.prefetch import prefetch
from spslam.errors import DatasetError
from spslam.evaluation.finished_run import NOVEL_VIEWS, surface_figures, view_figures
from spslam.evaluation.mesh_metrics import SAMPLES
from spslam.evaluation.run_output import RunOutput
from spslam.evaluation.surface import Surface, TriangleSurface
from spslam.evaluation.trajectory_metrics import ate, rpe
from spslam.run.device import resolve_device
from spslam.run.request import parse_frames
from spslam.run.sequence import RunRequest, run_sequence

_READING_THREADS, _READ_AHEAD = 2, 8


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
    figures = _measure_gicp(job, threads or 1) if job.method == GICP else _measure_spslam(job, folder)
    return {
        "job": vars(job),
        "environment": describe_environment(resolve_device(job.device)),
        "figures": {name: value for name, value in figures.items() if isinstance(value, (int, float))},
        "seconds": time.perf_counter() - started,
    }


def _frames(job: Job) -> slice | None:
    return None if job.frames is None else parse_frames(job.frames)


def _measure_spslam(job: Job, folder: Path) -> dict[str, Any]:
    config = job.load_config()
    data = None if job.data is None else Path(job.data)
    dataset = open_dataset(config.dataset, data)
    ground_truth = _true_surface(dataset, job.mesh)
    with_mesh = ground_truth is not None or job.thorough
    figures = run_sequence(RunRequest(config, data, folder, _frames(job), mesh=with_mesh))
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


def _measure_gicp(job: Job, threads: int) -> dict[str, Any]:
    dataset = open_sequence(job.load_config().dataset, None if job.data is None else Path(job.data), _frames(job))
    ground_truth = dataset.poses()
    first_pose = ground_truth[0] if ground_truth is not None and bool(np.isfinite(ground_truth[0]).all()) else np.eye(4)
    odometry = GicpOdometry(dataset.camera, first_pose, threads=threads, **dict(job.method_options))
    torch.set_num_threads(1)
    read, started = [], time.perf_counter()
    with prefetch(dataset, _READING_THREADS, _READ_AHEAD) as frames:
        for number, frame in enumerate(frames):
            if not isinstance(frame, DatasetError):
                odometry.process(frame.depth)
                read.append(number)
    wall_s = time.perf_counter() - started
    poses = np.array(odometry.poses)
    figures = {
        "frames": len(poses),
        "skipped_frames": len(dataset) - len(poses),
        "lost_frames": sum(odometry.lost),
        "wall_s": wall_s,
        "fps": len(poses) / wall_s,
        "peak_rss_mb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024,
    }
    return figures | (
        {} if ground_truth is None else {**ate(poses, ground_truth[read]), **rpe(poses, ground_truth[read])}
    )
