"""A sequence from a data set to an output folder."""

import contextlib
import hashlib
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch

from spslam import ops
from spslam.config import Config, dump_config
from spslam.datasets import open_sequence
from spslam.datasets.base import RgbdDataset
from spslam.errors import OutputError
from spslam.io import atomic_write
from spslam.run.device import explained_failures, resolve_device
from spslam.run.frame_feed import FrameFeed
from spslam.run.loop import Progress, RunLoop
from spslam.run.output_folder import RunFiles
from spslam.run.results import provenance, write_results
from spslam.run.warm_up import warm_up
from spslam.slam.checkpoint import load_checkpoint
from spslam.slam.system import SlamSystem


def run_sequence(
    config: Config,
    data_dir: Path | None,
    output_dir: Path,
    frames: slice | None = None,
    resume: bool = False,
    mesh: bool = True,
    progress: Progress | None = None,
) -> dict[str, Any]:
    """Runs SLAM over a sequence and leaves trajectory, map, mesh, metrics and log in `output_dir`.

    Args:
        config: settings; `config.dataset` says how to read the data.
        data_dir: the data set's folder; None for the generated room.
        output_dir: made if needed; must be empty, or hold this run's checkpoint with `resume`.
        frames: which frames of the data set, all where None.
        resume: go on from the checkpoint in `output_dir`, if there is one.
        mesh: whether to extract the mesh.
        progress: called with (frames done, frames in all, report of the frame; None for a skipped one).

    Returns:
        What is written to metrics.json.

    Raises:
        SpslamError: one clear line about what is wrong with the data, the settings, the device or the folder.
    """
    device = resolve_device(config.device)
    with _threads_to_the_kernels(), explained_failures(device):
        return _run(config, device, data_dir, output_dir, frames, resume, mesh, progress)


@contextlib.contextmanager
def _threads_to_the_kernels() -> Iterator[None]:
    """Keeps torch's and OpenCV's own threads from spinning on the cores that kernels and decoding need."""
    threads, decoder_threads = torch.get_num_threads(), cv2.getNumThreads()
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)
        cv2.setNumThreads(decoder_threads)


@contextlib.contextmanager
def _one_thread_a_frame(device: torch.device) -> Iterator[None]:
    """For a GPU the CPU kernels only sample frames, each on its reading thread: more threads would be in their way."""
    threads = ops.get_num_threads()
    if device.type == "cuda":
        ops.set_num_threads(1)
    try:
        yield
    finally:
        ops.set_num_threads(threads)


def _run(
    config: Config,
    device: torch.device,
    data_dir: Path | None,
    output_dir: Path,
    frames: slice | None,
    resume: bool,
    mesh: bool,
    progress: Progress | None,
) -> dict[str, Any]:
    started = time.perf_counter()
    dataset = open_sequence(config.dataset, data_dir, frames)
    system = SlamSystem(config, dataset.camera, _first_pose(config, dataset), device)
    files = RunFiles(output_dir)
    position, clock = _begin(files, system, dataset, data_dir, resume)
    with FrameFeed(dataset, config, device, position) as feed:
        if device.type == "cuda":
            warm_up(config, dataset.camera, device)
            torch.cuda.reset_peak_memory_stats(device)
        feed.prepare()
        clock["start_s"] = time.perf_counter() - started
        with _one_thread_a_frame(device):
            RunLoop(system, feed, len(dataset), files, _identity(dataset, data_dir), clock, progress).run(position)
    return write_results(system, dataset, config, files, clock, mesh)


def _first_pose(config: Config, dataset: RgbdDataset) -> np.ndarray | None:
    poses = dataset.poses() if config.scene.first_pose == "dataset" else None
    return poses[0] if poses is not None and bool(np.isfinite(poses[0]).all()) else None


def _begin(
    files: RunFiles, system: SlamSystem, dataset: RgbdDataset, data_dir: Path | None, resume: bool
) -> tuple[int, dict[str, Any]]:
    """Makes the folder, or picks up where its checkpoint stands; returns where in the data set, and the clock."""
    if resume and files.checkpoint.exists():
        source = load_checkpoint(files.checkpoint, system.state, system.config)
        if source["data"] != _identity(dataset, data_dir):
            raise OutputError(f"{files.folder}: belongs to a run over other data or frames; use another --output")
        files.remove_temporaries()
        files.keep_log(len(system.state.frames), source["next"])
        return source["next"], source["clock"]
    files.create(resume)
    atomic_write(files.config, dump_config(system.config, provenance(system.config, system.device)))
    return 0, {"frames": 0, "wall_s": 0.0, "decode_s": 0.0}


def _identity(dataset: RgbdDataset, data_dir: Path | None) -> dict[str, Any]:
    """What tells the frames of one run from those of another."""
    return {
        "folder": str(Path(data_dir).resolve()) if data_dir else "",
        "frames": len(dataset),
        "timestamps": hashlib.sha256(dataset.timestamps().tobytes()).hexdigest()[:16],
    }
