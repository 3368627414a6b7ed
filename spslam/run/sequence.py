"""SLAM over a sequence: from a dataset to an output folder."""

import contextlib
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch

from spslam import ops
from spslam.config import Config
from spslam.datasets import open_sequence
from spslam.datasets.base import RgbdDataset
from spslam.run.device import explained_failures, resolve_device
from spslam.run.frame_feed import FrameFeed
from spslam.run.loop import Progress, RunLoop
from spslam.run.output_folder import OutputFolder
from spslam.run.request import RunRequest
from spslam.run.results import write_results
from spslam.run.session import finished_metrics, open_session
from spslam.run.warm_up import warm_up
from spslam.slam.system import SlamSystem

__all__ = ["Progress", "RunRequest", "run_sequence"]


def run_sequence(request: RunRequest, progress: Progress | None = None) -> dict[str, Any]:
    """Runs SLAM over a sequence and writes trajectory, map, mesh, metrics, log and report.

    A request that resumes a finished run returns its metrics and changes nothing.

    Args:
        request: options, data and output folder.
        progress: called after each frame with (frames done, total frames, report of the frame or None if the frame
            could not be read).

    Returns:
        What is written to metrics.json.

    Raises:
        SpslamError: one line about what is wrong with the data, the options, the device or the output folder.
        KeyboardInterrupt: after Ctrl-C, between two frames.

    Example:
        >>> config = load_config("demo", preset="fast")
        >>> run_sequence(RunRequest(config, None, Path("runs/library"), frames=slice(0, 30)))["frames"]
        30
    """
    device = resolve_device(request.config.device)
    with _library_threads_limited(), explained_failures(device):
        return _run(request, device, progress)


@contextlib.contextmanager
def _library_threads_limited() -> Iterator[None]:
    """Restricts torch and OpenCV to one thread each: theirs would compete with the kernels and the reading threads."""
    threads, decoder_threads = torch.get_num_threads(), cv2.getNumThreads()
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)
        cv2.setNumThreads(decoder_threads)


@contextlib.contextmanager
def _kernel_threads_limited(device: torch.device) -> Iterator[None]:
    """On CUDA, restricts the CPU kernels to one thread: they only sample frames, one on each reading thread."""
    threads = ops.get_num_threads()
    if device.type == "cuda":
        ops.set_num_threads(1)
    try:
        yield
    finally:
        ops.set_num_threads(threads)


def _run(request: RunRequest, device: torch.device, progress: Progress | None) -> dict[str, Any]:
    started = time.perf_counter()
    dataset = open_sequence(request.config.dataset, request.data_dir, request.frames)
    system = SlamSystem(request.config, dataset.camera, _first_pose(request.config, dataset), device)
    with OutputFolder(Path(request.output_dir)).locked():
        finished = finished_metrics(request, dataset)
        return _process(request, dataset, system, progress, started) if finished is None else finished


def _process(
    request: RunRequest, dataset: RgbdDataset, system: SlamSystem, progress: Progress | None, started: float
) -> dict[str, Any]:
    config, device = request.config, system.device
    session = open_session(request, dataset, system)
    with FrameFeed(dataset, config, device, session.start) as feed:
        if device.type == "cuda":
            warm_up(config, dataset.camera, device)
            torch.cuda.reset_peak_memory_stats(device)
        feed.prepare()
        session.clock.start_s = time.perf_counter() - started
        with _kernel_threads_limited(device):
            RunLoop(system, feed, session, progress).run()
    return write_results(system, dataset, request, session)


def _first_pose(config: Config, dataset: RgbdDataset) -> np.ndarray | None:
    poses = dataset.poses() if config.scene.first_pose == "dataset" else None
    return poses[0] if poses is not None and bool(np.isfinite(poses[0]).all()) else None
