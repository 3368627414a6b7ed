"""A sequence from a data set to an output folder."""

import contextlib
import json
import resource
import time
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import torch

from spslam import __version__
from spslam.config import Config, dump_config
from spslam.datasets import open_dataset
from spslam.datasets.base import RgbdDataset, RgbdFrame, Subset
from spslam.datasets.prefetch import prefetch
from spslam.errors import DatasetError, DeviceError, OutputError
from spslam.evaluation.trajectory import ate, rpe
from spslam.io import atomic_write
from spslam.slam.checkpoint import load_checkpoint, save_checkpoint
from spslam.slam.pixels import FramePixels, sample_frame
from spslam.slam.run_files import RunFiles
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
) -> dict:
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
) -> dict:
    dataset = open_dataset(config.dataset, data_dir)
    if frames is not None:
        dataset = Subset(dataset, frames.start or 0, frames.stop, frames.step or 1)
    truth = dataset.poses()
    system = SlamSystem(config, dataset.camera, _first_pose(config, truth), device)
    files = RunFiles(output_dir)
    source = {"data": str(Path(data_dir).resolve()) if data_dir else "", "frames": len(dataset), "next": 0}
    done = _begin(files, system, config, source, resume)
    loop = _Loop(system, dataset, config, files, source, done, progress)
    loop.run()
    system.finish()
    return _finish(system, config, files, loop, truth, mesh)


def _begin(files: RunFiles, system: SlamSystem, config: Config, source: dict, resume: bool) -> int:
    """Makes the folder, or picks up where its checkpoint stands; returns the position in the data set."""
    if resume and files.checkpoint.exists():
        saved = load_checkpoint(files.checkpoint, system.state, config)
        if (saved["data"], saved["frames"]) != (source["data"], source["frames"]):
            raise OutputError(f"{files.folder}: belongs to a run over other data; use another --output")
        files.keep_log_lines(len(system.state.frames))
        return saved["next"]
    files.create(resume)
    atomic_write(files.config, dump_config(config, provenance(config, system.device)))
    return 0


def provenance(config: Config, device: torch.device) -> dict:
    """What a run's files say of where they come from."""
    return {
        "version": __version__,
        "torch": torch.__version__,
        "seed": config.seed,
        "device": str(device),
        "device_name": torch.cuda.get_device_name(device) if device.type == "cuda" else _processor(),
    }


def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        return "cpu"
    return next((line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")), "cpu")


def _first_pose(config: Config, truth: np.ndarray | None) -> np.ndarray | None:
    known = truth is not None and bool(np.isfinite(truth[0]).all())
    return truth[0] if known and config.scene.first_pose == "dataset" else None


class _Loop:
    """The loop over the frames, with its log, checkpoints and clock."""

    def __init__(
        self,
        system: SlamSystem,
        dataset: RgbdDataset,
        config: Config,
        files: RunFiles,
        source: dict,
        start: int,
        progress: Progress | None,
    ):
        self.system, self.dataset, self.config, self.files = system, dataset, config, files
        self.source, self.start, self.progress = source, start, progress
        self.wall_s = 0.0
        self.decode_s = 0.0
        self.done = 0

    def run(self) -> None:
        run, total = self.config.run, len(self.dataset)
        prepared = _PreparedFrames(self.dataset, self.config, self.start)
        started = time.perf_counter()
        with prefetch(prepared, run.prefetch_workers, run.prefetch_ahead) as reader, self.files.open_log() as log:
            for position, item in enumerate(reader, self.start):
                report = self._take(item, position, log)
                self.done += 1
                if self.progress:
                    self.progress(position + 1, total, report)
                if run.checkpoint_every and (position + 1) % run.checkpoint_every == 0 and position + 1 < total:
                    log.flush()
                    self._checkpoint(position + 1)
            self.decode_s = reader.read_seconds
        self.wall_s = time.perf_counter() - started

    def _take(self, item: PreparedFrame | DatasetError, position: int, log) -> FrameReport | None:
        if isinstance(item, DatasetError):
            self.files.record_skipped(position, item)
            return None
        report = self.system.process(item.frame, item.pixels)
        log.write(json.dumps(asdict(report)) + "\n")
        return report

    def _checkpoint(self, position: int) -> None:
        save_checkpoint(self.files.checkpoint, self.system.state, self.config, {**self.source, "next": position})


def _finish(
    system: SlamSystem, config: Config, files: RunFiles, loop: _Loop, truth: np.ndarray | None, mesh: bool
) -> dict:
    """Writes the results; the checkpoint goes last, as from then on there is nothing to resume."""
    state = system.state
    if len(state.frames) == 0:
        raise DatasetError(f"{loop.dataset.name}: no frame could be read; the first: {files.first_skipped()}")
    trajectory = system.trajectory()
    trajectory.save_tum(files.trajectory)
    state.scene.save(files.map)
    metrics = {
        **provenance(config, system.device),
        "frames": len(state.frames),
        "wall_s": loop.wall_s,
        "fps": loop.done / loop.wall_s if loop.wall_s else 0.0,
        "decode_ms": 1e3 * loop.decode_s / max(loop.done, 1),
        **_timings(files.read_log()),
        "lost_frames": int(state.frames.lost.sum()),
        "skipped_frames": files.count_skipped(),
        "voxels": state.scene.volume.num_voxels,
        "model_mb": state.scene.nbytes / 2**20,
        "peak_rss_mb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024,
    }
    if system.device.type == "cuda":
        metrics["peak_gpu_mb"] = torch.cuda.max_memory_allocated(system.device) / 2**20
    if truth is not None:
        known = truth[state.frames.indices.numpy()]
        metrics |= {**ate(trajectory.poses, known), **rpe(trajectory.poses, known)}
    if mesh:
        metrics["mesh_s"] = files.write_mesh(state.scene, config.mesh.resolution_m)
    atomic_write(files.metrics, json.dumps(metrics, indent=1) + "\n")
    files.write_report(loop.dataset, state.frames.indices.tolist(), truth, config.run.previews)
    files.checkpoint.unlink(missing_ok=True)
    return metrics


def _timings(log: list[dict]) -> dict:
    """The timing figures of metrics.json, from the log."""
    tracked = [line for line in log if line["tracking_iterations"]]
    mapped = [line for line in log if line["mapping_iterations"]]
    later = mapped[1:]
    figures: dict[str, float] = {}
    if tracked:
        seconds = sum(line["tracking_ms"] for line in tracked) / 1e3
        iterations = sum(line["tracking_iterations"] for line in tracked)
        figures["tracking_ms_per_iteration"] = 1e3 * seconds / iterations
        figures["tracking_iterations"] = tracked[-1]["tracking_iterations"]
        figures["tracking_fps"] = len(tracked) / seconds
    if mapped:
        figures["first_mapping_s"] = mapped[0]["mapping_ms"] / 1e3
        figures["encode_ms"] = sum(line["encode_ms"] for line in mapped) / len(mapped)
    if later:
        total = sum(line["mapping_iterations"] for line in later)
        figures["mapping_ms_per_iteration"] = sum(line["mapping_ms"] for line in later) / total
        figures["mapping_iterations"] = later[-1]["mapping_iterations"]
    return figures
