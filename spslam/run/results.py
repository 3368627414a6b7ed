"""What a finished run writes: trajectory, map, mesh, metrics and report."""

import json
import resource
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from spslam.config import Config
from spslam.datasets.base import RgbdDataset, RgbdFrame
from spslam.errors import DatasetError
from spslam.evaluation.run_output import RunOutput
from spslam.evaluation.verdict import judge_run
from spslam.io import atomic_write
from spslam.run.clock import RunClock
from spslam.run.figures import (
    decoding_figures,
    graph_figures,
    noise_figures,
    origin,
    scene_figures,
    timing_figures,
    timings,
    tracking_figures,
    truth_figures,
)
from spslam.run.mesh import EarlierFrames, MeshJob, measured_readout_s, noise_of_model, write_mesh
from spslam.run.output_folder import OutputFolder
from spslam.run.recordings import read_again, source_of
from spslam.run.request import RunRequest
from spslam.run.session import RunSession
from spslam.slam.graph.archive import KeyframeArchive, Recording
from spslam.slam.opened_map import archive_of
from spslam.slam.system import SlamSystem
from spslam.trajectory import Trajectory


@dataclass(frozen=True)
class RunInput:
    """What the results need of the frames that a run was over.

    Attributes:
        name: of the sequence or the camera.
        poses: float64 [F, 4, 4] ground truth of the rows of the trajectory, NaN where unknown; None if there is none.
        ground_truth: poses of all frames where they are known; None if none is.
        previews: row in the trajectory and frame, for each image of the report.
        dataset: the frames, where they can be read again; None for a camera's.
    """

    name: str
    poses: np.ndarray | None
    ground_truth: Trajectory | None
    previews: Iterable[tuple[int, RgbdFrame]]
    dataset: RgbdDataset | None = None

    @classmethod
    def of_dataset(cls, dataset: RgbdDataset, indices: list[int], previews: int) -> "RunInput":
        """That of a dataset.

        Args:
            dataset: of the run.
            indices: index in the dataset of each row of the trajectory.
            previews: how many frames are shown, spread evenly over the run.
        """
        poses, ground_truth = dataset.poses(), None
        if poses is not None:
            known = np.isfinite(poses).all((1, 2))
            ground_truth = Trajectory(dataset.timestamps()[known], poses[known])
        rows = np.unique(np.linspace(0, len(indices) - 1, previews).round().astype(int)).tolist()
        frames = ((row, dataset[indices[row]]) for row in rows)
        known_poses = None if poses is None else poses[np.array(indices, dtype=np.int64)]
        return cls(dataset.name, known_poses, ground_truth, frames, dataset)


def write_results(
    system: SlamSystem,
    source: RunInput,
    request: RunRequest,
    session: RunSession,
    figures: Mapping[str, Any] | None = None,
) -> dict[str, Any]:
    """Writes all results and then removes the checkpoint, as there is nothing left to resume.

    Args:
        system: after the last frame.
        source: what is known of the input.
        request: of the run; says whether a mesh is wanted.
        session: with the output folder and the clock of the whole run.
        figures: further metrics.

    Returns:
        What is written to metrics.json.

    Raises:
        SpslamError: there is no frame, all frames are lost, or a file can't be written.
    """
    config, folder, clock = request.config, session.folder, session.clock
    frames, skipped = system.state.frames.processed, folder.read_skipped()
    if frames == 0:
        first = f"; the first: {skipped[0]['error']}" if skipped else ""
        raise DatasetError(f"{source.name}: no frame could be read{first}")
    trajectory, log = system.trajectory(), folder.read_log()
    lost = trajectory.lost
    if lost.all():
        raise DatasetError(
            _not_found(source.name, request.map) if request.map else _nothing_known(source.name, config, log)
        )
    trajectory.save_tum(folder.trajectory)
    system.state.scene.save(folder.map)
    written = Trajectory.load_tum(folder.trajectory)
    archive = _save_keyframes(system, source, request, folder)
    metrics = {
        **origin(config, system.device, request.command),
        "data": session.identity,
        "frames": frames,
        **_speed(clock),
        **timings(log, clock),
        **(figures or {}),
        **tracking_figures(trajectory, log),
        **write_segments(folder, system.segments()),
        "skipped_frames": len(skipped),
        **_sizes(system),
    }
    earlier: list[EarlierFrames] = []
    missing: list[str] = []
    if archive is not None and request.map is not None:
        earlier, missing = read_again(archive, archive.recordings[:-1])
        metrics |= {"map": str(request.map), "found_frame": int((~lost).argmax())}
    if not request.mesh or config.mesh.source == "neural" or source.dataset is None:
        missing = []
    if session.warnings or missing:
        metrics["warnings"] = [*session.warnings, *missing]
    sensor = system.state.noise
    noise = sensor.model
    metrics |= {**truth_figures(trajectory, source.poses), **noise_figures(noise)}
    metrics |= timing_figures(sensor.color_delay, sensor.readout)
    if request.mesh:
        # The trajectory is the file's, so that `spslam mesh` makes the same one.
        of_sensor = noise_of_model(noise), measured_readout_s(metrics)
        job = MeshJob(system.state.scene, written, system.camera, config.mesh, *of_sensor, earlier)
        metrics |= write_mesh(folder.mesh, job, source.dataset)[1]
    finish_results(RunOutput(folder, trajectory, source.poses, metrics, log, "", system.camera), source, config)
    folder.checkpoint.unlink(missing_ok=True)
    return metrics


def write_segments(folder: OutputFolder, segments: Sequence[Trajectory]) -> dict[str, int]:
    """Writes the poses of frames that are known among themselves only; returns the figure for metrics.json.

    Args:
        folder: of the run.
        segments: of frames that are lost in the run's trajectory, each in axes of its own.
    """
    for number, segment in enumerate(segments, start=1):
        segment.save_tum(folder.segment(number))
    return {"unjoined_frames": sum(map(len, segments))}


def finish_results(run: RunOutput, source: RunInput, config: Config) -> None:
    """Writes what comes last, from all other results: previews, metrics.json with the verdict, and the report.

    Args:
        run: the results; the verdict is added to its metrics.
        source: what is known of the input.
        config: of the run.
    """
    folder, camera = OutputFolder(run.folder.path), run.camera
    if camera is None:
        raise ValueError("finish_results: run must have a camera")
    folder.write_previews(camera, source.previews, source.ground_truth)
    run.metrics["verdict"] = judge_run(run, config).level
    atomic_write(folder.metrics, json.dumps(run.metrics, indent=1) + "\n")
    folder.write_report()


def _save_keyframes(
    system: SlamSystem, source: RunInput, request: RunRequest, folder: OutputFolder
) -> KeyframeArchive | None:
    """Writes what the map is opened again by; None without a keyframe graph."""
    if system.state.graph is None:
        return None
    frames = {} if source.dataset is None else source_of(request)
    recording = Recording(source.name, frames, system.camera, system.trajectory())
    archive = archive_of(system.state, recording, system.map_settings())
    archive.save(folder.keyframes)
    return archive


def _not_found(name: str, folder: Path) -> str:
    return (
        f"{name}: the camera was not found in the map {folder}: image features and surface of no frame show a place of "
        "it; begin where the map was recorded, in similar light, or run without --map and join the two "
        "with spslam merge"
    )


def _nothing_known(name: str, config: Config, log: Sequence[Mapping[str, Any]]) -> str:
    depth = config.dataset
    known = max((line.get("valid_depth_share") or 0.0 for line in log), default=0.0)
    if known >= config.tracking.min_valid_depth_share:
        return (
            f"{name}: all frames are lost although up to {100 * known:.0f} % of their pixels have depth: none gave a "
            "surface to begin a map with; images must not be tiny, and scene.voxel_size_m "
            f"({config.scene.voxel_size_m:g} m) must suit the distance between their pixels"
        )
    return (
        f"{name}: all frames are lost: none shows a surface between dataset.min_depth_m "
        f"({depth.min_depth_m:g} m) and dataset.max_depth_m ({depth.max_depth_m:g} m) in at least "
        f"tracking.min_valid_depth_share ({config.tracking.min_valid_depth_share:g}) of its pixels; "
        "`spslam check-data` shows what the depth images hold"
    )


def _speed(clock: RunClock) -> dict[str, float]:
    return {
        "start_s": clock.start_s,
        "wall_s": clock.wall_s,
        "fps": clock.frames / clock.wall_s if clock.wall_s else 0.0,
        **decoding_figures(clock),
    }


def _sizes(system: SlamSystem) -> dict[str, float]:
    sizes = {
        **scene_figures(system.state.scene),
        "peak_rss_mb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024,
    }
    graph = system.state.graph
    if graph is not None:
        sizes |= graph_figures(len(graph.keyframes), graph.content.edges)
    if system.device.type == "cuda":
        sizes["peak_gpu_mb"] = torch.cuda.max_memory_allocated(system.device) / 2**20
    return sizes
