"""SLAM over a sequence: from a dataset to an output folder."""

import contextlib
import time
from pathlib import Path
from typing import Any

import numpy as np
import torch

from spslam.config import Config
from spslam.datasets.base import RgbdDataset
from spslam.notebook import RunProgress, in_notebook
from spslam.run.data_check import OpenedData
from spslam.run.device import explained_failures, resolve_device
from spslam.run.frame_feed import FrameFeed
from spslam.run.loop import Progress, RunLoop
from spslam.run.observer import ObservedRun, RunObserver
from spslam.run.output_folder import OutputFolder
from spslam.run.request import RunRequest
from spslam.run.results import RunInput, write_results
from spslam.run.session import finished_metrics, open_session
from spslam.run.threads import kernel_threads_limited, library_threads_limited
from spslam.run.warm_up import warm_up
from spslam.slam.interpreter import interpreter_shared
from spslam.slam.system import SlamSystem

__all__ = ["Progress", "RunRequest", "first_pose", "run_sequence"]


def run_sequence(
    request: RunRequest,
    progress: Progress | None = None,
    observer: RunObserver | None = None,
    opened: OpenedData | None = None,
) -> dict[str, Any]:
    """Runs SLAM over a sequence and writes trajectory, map, mesh, metrics, log and report.

    A request that resumes a finished run returns its metrics and changes nothing.

    Args:
        request: options, data and output folder.
        progress: called after each frame with (frames done, total frames, report of the frame or None if the frame
            could not be read). In a notebook, None shows a progress bar in the cell.
        observer: watches the run, as the viewer does (`spslam.viewer`); results are the same without it.
        opened: the request's data, where they were opened before; None opens them.

    Returns:
        What is written to metrics.json.

    Raises:
        SpslamError: one line about what is wrong with the data, the options, the device or the output folder; with
            `run.data_check: stop` also where the first frames plainly do not fit together.
        KeyboardInterrupt: after Ctrl-C, between two frames.

    Example:
        >>> config = load_config("demo", preset="fast")
        >>> run_sequence(RunRequest(config, None, Path("runs/library"), frames=slice(0, 30)))["frames"]
        30
    """
    device = resolve_device(request.config.device)
    if progress is None and in_notebook():
        progress = RunProgress()
    with library_threads_limited(), explained_failures(device):
        opened = opened or OpenedData(request)
        started = time.perf_counter() - opened.opening_s
        return _run(request, opened, device, progress, observer or RunObserver(), started)


def _run(
    request: RunRequest,
    opened: OpenedData,
    device: torch.device,
    progress: Progress | None,
    observer: RunObserver,
    started: float,
) -> dict[str, Any]:
    dataset = opened.dataset
    system = SlamSystem(request.config, dataset.camera, first_pose(request.config, dataset), device)
    with contextlib.closing(system):
        warnings = opened.doubts()
        if request.map is not None:
            system.open_map(request.map)
        with OutputFolder(Path(request.output_dir)).locked():
            finished = finished_metrics(request, dataset)
            if finished is not None:
                return finished
            session = open_session(request, dataset, system, warnings)
            earlier = session.folder.read_log() if session.start else []
            observer.begin(ObservedRun.of(request, dataset, earlier), system.state)
            with FrameFeed(dataset, request.config, device, session.start, system.state.frames.processed) as feed:
                poses = first_poses(request.config, dataset)
                _process(feed, RunLoop(system, feed, session, progress, observer, poses), started)
            frames = system.state.frames
            indices = frames.indices[frames.opened :].tolist()
            source = RunInput.of_dataset(dataset, indices, request.config.run.previews)
            return write_results(system, source, request, session)


def _process(feed: FrameFeed, loop: RunLoop, started: float) -> None:
    system = loop.system
    device = system.device
    if device.type == "cuda":
        warm_up(system.config, system.camera, device)
        torch.cuda.reset_peak_memory_stats(device)
    feed.prepare()
    loop.session.clock.start_s = time.perf_counter() - started
    with kernel_threads_limited(device), interpreter_shared():
        loop.run()


def first_pose(config: Config, dataset: RgbdDataset) -> np.ndarray | None:
    """The pose that a run over a dataset begins at, float64 [4, 4]; None where it is to be the identity."""
    poses = first_poses(config, dataset)
    return poses[0] if poses is not None and bool(np.isfinite(poses[0]).all()) else None


def first_poses(config: Config, dataset: RgbdDataset) -> np.ndarray | None:
    """Poses float64 [F, 4, 4] by frame, NaN where unknown, one of which the map begins at; None where it is to be the
    identity."""
    return dataset.poses() if config.scene.first_pose == "dataset" else None
