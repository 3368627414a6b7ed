"""One run of a baseline in this process, evaluated against ground truth."""

from __future__ import annotations

import resource
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import torch

from spslam.benchmark.gicp import GicpOdometry
from spslam.benchmark.jobs import Job
from spslam.benchmark.orb_slam3 import OrbSlam3
from spslam.datasets import open_sequence
from spslam.datasets.base import RgbdDataset, RgbdFrame
from spslam.datasets.prefetch import prefetch
from spslam.errors import DatasetError
from spslam.evaluation.trajectory_metrics import ate, rpe
from spslam.run.request import parse_frames
from spslam.trajectory import Trajectory

_READING_THREADS, _READ_AHEAD = 2, 8
_DEFAULT_RATE_HZ = 30.0


def measure_gicp(job: Job, threads: int) -> dict[str, float]:
    """Runs GICP odometry over a job's frames.

    Args:
        job: what to run.
        threads: of the registration.

    Returns:
        Figures by name. A lost frame counts with its predicted pose.

    Raises:
        SpslamError: something is wrong with the data, or small_gicp is missing.
    """
    dataset = _open(job)
    ground_truth = dataset.poses()
    first_pose = ground_truth[0] if ground_truth is not None and bool(np.isfinite(ground_truth[0]).all()) else np.eye(4)
    odometry = GicpOdometry(dataset.camera, first_pose, threads=threads, **dict(job.method_options))
    read, wall_s = _process_all(dataset, lambda frame: odometry.process(frame.depth))
    figures = _speed_figures(dataset, read, wall_s, resource.RUSAGE_SELF) | {"lost_frames": sum(odometry.lost)}
    if ground_truth is None:
        return figures
    poses = np.array(odometry.poses)
    return {**figures, **ate(poses, ground_truth[read]), **rpe(poses, ground_truth[read])}


def measure_orb_slam3(job: Job) -> dict[str, float]:
    """Runs ORB-SLAM3 over a job's frames.

    Loading the vocabulary does not count as time, nor does what loop closing still has to do after the last frame.

    Args:
        job: what to run.

    Returns:
        Figures by name. Errors are those of the final trajectory over the frames that have a pose in it, and
        `ate_live_cm` is that of the poses as they were tracked. The memory is that of ORB-SLAM3's process.

    Raises:
        SpslamError: something is wrong with the data, pyorbslam3 or its vocabulary is missing, or ORB-SLAM3 fails.
    """
    dataset = _open(job)
    with OrbSlam3(dataset.camera, _rate_hz(dataset)) as slam:
        read, wall_s = _process_all(dataset, slam.process)
        final, live = slam.finish(), slam.live
    figures = _speed_figures(dataset, read, wall_s, resource.RUSAGE_CHILDREN)
    figures["lost_frames"] = sum(pose is None for pose in final)
    ground_truth = dataset.poses()
    if ground_truth is None:
        return figures
    poses, reference = _tracked(final, ground_truth[read])
    live_ate = ate(*_tracked(live, ground_truth[read]))
    figures |= {"ate_live_cm": live_ate["ate_rmse_cm"]} if live_ate else {}
    return {**figures, **ate(poses, reference), **rpe(poses, reference)}


def _open(job: Job) -> RgbdDataset:
    frames = None if job.frames is None else parse_frames(job.frames)
    return open_sequence(job.load_config().dataset, None if job.data is None else Path(job.data), frames)


def _process_all(dataset: RgbdDataset, process: Callable[[RgbdFrame], object]) -> tuple[list[int], float]:
    """Processes all readable frames; returns their numbers and the time in seconds."""
    torch.set_num_threads(1)
    read, started = [], time.perf_counter()
    with prefetch(dataset, _READING_THREADS, _READ_AHEAD) as frames:
        for number, frame in enumerate(frames):
            if not isinstance(frame, DatasetError):
                process(frame)
                read.append(number)
    return read, time.perf_counter() - started


def _speed_figures(dataset: RgbdDataset, read: list[int], wall_s: float, process: int) -> dict[str, float]:
    return {
        "frames": len(read),
        "skipped_frames": len(dataset) - len(read),
        "wall_s": wall_s,
        "fps": len(read) / wall_s,
        "peak_rss_mb": resource.getrusage(process).ru_maxrss / 1024,
    }


def _tracked(poses: Sequence[np.ndarray | None], ground_truth: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Poses [F, 4, 4] with placeholders for those that are None, and the ground truth, NaN there."""
    lost = np.array([pose is None for pose in poses])
    rows = np.array([np.eye(4) if pose is None else pose for pose in poses]).reshape(-1, 4, 4)
    trajectory = Trajectory(np.arange(len(rows)), rows, lost)
    return trajectory.poses, trajectory.mask_lost(ground_truth)


def _rate_hz(dataset: RgbdDataset) -> float:
    steps = np.diff(dataset.timestamps())
    steps = steps[steps > 0]
    return 1 / float(np.median(steps)) if steps.size else _DEFAULT_RATE_HZ
