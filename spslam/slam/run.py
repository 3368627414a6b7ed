"""A sequence from a data set to an output folder."""

import contextlib
import hashlib
import json
import os
import time
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import IO, Any

import numpy as np
import torch

from spslam.config import Config, dump_config
from spslam.datasets import open_sequence
from spslam.datasets.base import RgbdDataset, RgbdFrame
from spslam.datasets.prefetch import prefetch
from spslam.errors import DatasetError, DeviceError, OutputError
from spslam.io import atomic_write
from spslam.slam.checkpoint import load_checkpoint, save_checkpoint
from spslam.slam.pixels import FramePixels, sample_frame
from spslam.slam.run_files import RunFiles
from spslam.slam.run_results import provenance, write_results
from spslam.slam.system import FrameReport, SlamSystem

Progress = Callable[[int, int, FrameReport | None], None]


@dataclass(frozen=True)
class PreparedFrame:
    """A frame with what is computed ahead of it on the reading thread."""

    frame: RgbdFrame
    pixels: FramePixels


class _PreparedFrames:
    """Reads a data set's frames from `start` on and samples their pixels; what the prefetch threads run."""

    def __init__(self, dataset: RgbdDataset, config: Config, start: int):
        self.dataset, self.config, self.start = dataset, config, start

    def __len__(self) -> int:
        return len(self.dataset) - self.start

    def __getitem__(self, i: int) -> PreparedFrame:
        frame = self.dataset[i + self.start]
        return PreparedFrame(frame, sample_frame(frame, self.dataset.camera, self.config))


def resolve_device(name: str) -> torch.device:
    """The torch device of `auto`, `cpu`, `cuda` or `cuda:N`.

    Raises:
        DeviceError: the device is not there.
    """
    from spslam import ops

    if name == "auto":
        name = "cpu" if ops.CUDA_OFF_REASON else "cuda"
    try:
        device = torch.device(name)
    except RuntimeError:
        raise DeviceError(f"device must be auto, cpu, cuda or cuda:N, got {name}") from None
    if device.type == "cuda":
        if ops.CUDA_OFF_REASON:
            raise DeviceError(f"device {name} is not available: {ops.CUDA_OFF_REASON}; use --device cpu")
        if device.index is not None and device.index >= torch.cuda.device_count():
            raise DeviceError(f"device {name} is not available: there are {torch.cuda.device_count()} CUDA devices")
    elif device.type != "cpu":
        raise DeviceError(f"device must be auto, cpu, cuda or cuda:N, got {name}")
    return device


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
    with _one_torch_thread():
        return _run(config, device, data_dir, output_dir, frames, resume, mesh, progress)


@contextlib.contextmanager
def _one_torch_thread() -> Iterator[None]:
    """Keeps torch's own threads from spinning on the cores that the kernels' threads need."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)


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
    dataset = open_sequence(config.dataset, data_dir, frames)
    system = SlamSystem(config, dataset.camera, _first_pose(config, dataset), device)
    files = RunFiles(output_dir)
    position, clock = _begin(files, system, dataset, data_dir, resume)
    loop = _Loop(system, dataset, data_dir, files, clock, progress)
    loop.run(position)
    system.finish()
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


class _Loop:
    """The loop over the frames, with its log, checkpoints and clock."""

    def __init__(
        self,
        system: SlamSystem,
        dataset: RgbdDataset,
        data_dir: Path | None,
        files: RunFiles,
        clock: dict[str, Any],
        progress: Progress | None,
    ):
        self.system, self.dataset, self.files = system, dataset, files
        self.clock, self.progress = clock, progress
        self.identity = _identity(dataset, data_dir)

    def run(self, start: int) -> None:
        """Processes the frames from position `start` on."""
        run, total, last_saved = self.system.config.run, len(self.dataset), start
        prepared = _PreparedFrames(self.dataset, self.system.config, start)
        before, started = dict(self.clock), time.perf_counter()
        with prefetch(prepared, run.prefetch_workers, run.prefetch_ahead) as reader, self.files.open_log() as log:
            for position, item in enumerate(reader, start):
                report = self._take(item, position, log)
                done = position + 1
                self.clock |= {
                    "frames": before["frames"] + done - start,
                    "wall_s": before["wall_s"] + time.perf_counter() - started,
                    "decode_s": before["decode_s"] + reader.read_seconds,
                }
                if self.progress:
                    self.progress(done, total, report)
                if done < total and _is_checkpoint_due(run.checkpoint_every, last_saved, done):
                    self._checkpoint(done, log)
                    last_saved = done

    def _take(self, item: PreparedFrame | DatasetError, position: int, log: IO[str]) -> FrameReport | None:
        if isinstance(item, DatasetError):
            self.files.record_skipped(position, item)
            return None
        report = self.system.process(item.frame, item.pixels)
        log.write(json.dumps(asdict(report)) + "\n")
        return report

    def _checkpoint(self, position: int, log: IO[str]) -> None:
        # The log must hold the frames of every checkpoint, also after a power cut.
        os.fsync(log.fileno())
        source = {"data": self.identity, "next": position, "clock": self.clock}
        save_checkpoint(self.files.checkpoint, self.system.state, self.system.config, source)


def _is_checkpoint_due(every: int, last_saved: int, done: int) -> bool:
    """Every so many frames, but as checkpoints grow with the frames, not before a tenth of them is new."""
    return every > 0 and done - last_saved >= max(every, done // 10)
