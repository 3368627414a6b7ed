"""What a finished run writes: trajectory, map, mesh, metrics and report."""

import json
import resource
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from spslam.config import Config
from spslam.datasets.base import RgbdDataset, RgbdFrame
from spslam.errors import DatasetError
from spslam.evaluation.run_output import RunOutput
from spslam.evaluation.trajectory_metrics import ate, rpe
from spslam.evaluation.verdict import judge_run
from spslam.io import atomic_write
from spslam.run.clock import RunClock
from spslam.run.mesh import EarlierFrames, MeshJob, noise_of_model, write_mesh
from spslam.run.output_folder import OutputFolder
from spslam.run.provenance import provenance
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
        raise DatasetError(_not_found(source.name, request.map) if request.map else _nothing_known(source.name, config))
    trajectory.save_tum(folder.trajectory)
    segments = system.segments()
    for number, segment in enumerate(segments, start=1):
        segment.save_tum(folder.segment(number))
    system.state.scene.save(folder.map)
    written = Trajectory.load_tum(folder.trajectory)
    archive = _save_keyframes(system, source, request, folder)
    metrics = {
        **provenance(config, system.device),
        **({"command": request.command} if request.command else {}),
        "data": session.identity,
        "frames": frames,
        **_speed(clock),
        **timings(log, clock),
        **(figures or {}),
        "lost_frames": int(lost.sum()),
        "unjoined_frames": sum(map(len, segments)),
        "tracking_failures": int((lost[1:] & ~lost[:-1]).sum()) + int(lost[0]),
        "recovered_frames": sum(line["recovered"] for line in log),
        "relocalized_frames": sum(line["relocalized"] for line in log),
        **max_error_probability(log),
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
    if source.poses is not None:
        known = trajectory.mask_lost(source.poses)
        metrics |= {**ate(trajectory.poses, known), **rpe(trajectory.poses, known)}
    if "ate_rmse_cm" not in metrics:
        metrics["unchecked"] = ["error", "depth scale", "mirrored images"]
    noise = noise_of_model(system.state.noise.model)
    metrics |= {"depth_noise_floor_m2": noise[0], "depth_noise_growth_m2": noise[1]}
    if request.mesh:
        # The trajectory is the file's, so that `spslam mesh` makes the same one.
        job = MeshJob(system.state.scene, written, system.camera, config.mesh, noise, earlier)
        metrics |= write_mesh(folder.mesh, job, source.dataset)[1]
    run = RunOutput(folder, trajectory, source.poses, metrics, log, "", system.camera)
    metrics["verdict"] = judge_run(run, config).level
    atomic_write(folder.metrics, json.dumps(metrics, indent=1) + "\n")
    folder.write_previews(system.camera, source.previews, source.ground_truth)
    folder.write_report()
    folder.checkpoint.unlink(missing_ok=True)
    return metrics


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


def _nothing_known(name: str, config: Config) -> str:
    depth = config.dataset
    return (
        f"{name}: all frames are lost: none shows a surface between dataset.min_depth_m "
        f"({depth.min_depth_m:g} m) and dataset.max_depth_m ({depth.max_depth_m:g} m) in at least "
        f"tracking.min_valid_depth_share ({config.tracking.min_valid_depth_share:g}) of its pixels; "
        "`spslam check-data` shows what the depth images hold"
    )


def max_error_probability(log: list[dict[str, Any]]) -> dict[str, float]:
    """The highest error probability of the accepted poses; empty where none was judged."""
    error_probabilities = [
        line["error_probability"] for line in log if not line["lost"] and line["error_probability"] is not None
    ]
    return {"max_error_probability": max(error_probabilities)} if error_probabilities else {}


def _speed(clock: RunClock) -> dict[str, float]:
    return {
        "start_s": clock.start_s,
        "wall_s": clock.wall_s,
        "fps": clock.frames / clock.wall_s if clock.wall_s else 0.0,
        "decode_ms": 1e3 * clock.decode_s / max(clock.frames, 1),
    }


def _sizes(system: SlamSystem) -> dict[str, float]:
    scene = system.state.scene
    sizes = {
        "voxels": scene.volume.num_voxels,
        "model_mb": scene.nbytes / 2**20,
        "peak_rss_mb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024,
    }
    graph = system.state.graph
    if graph is not None:
        kinds = [edge.kind for edge in graph.content.edges]
        sizes |= {"keyframes": len(graph.keyframes), "graph_edges": len(kinds), "closed_loops": kinds.count("loop")}
    if system.device.type == "cuda":
        sizes["peak_gpu_mb"] = torch.cuda.max_memory_allocated(system.device) / 2**20
    return sizes


def timings(log: list[dict[str, Any]], clock: RunClock) -> dict[str, float]:
    """Timings of metrics.json from the log: the stages' share of the loop, and time per iteration.

    Args:
        log: the lines of log.jsonl.
        clock: of the run.
    """
    tracked = [line for line in log if line["tracking_iterations"]]
    mapped = [line for line in log if line["mapping_iterations"]]
    later = mapped[1:]
    figures = _stage_times(log, clock)
    if tracked:
        seconds = sum(line["tracking_ms"] for line in tracked) / 1e3
        iterations = sum(line["tracking_iterations"] for line in tracked)
        figures["tracking_ms_per_iteration"] = 1e3 * seconds / iterations
        figures["tracking_iterations"] = tracked[-1]["tracking_iterations"]
        figures["tracking_fps"] = len(tracked) / seconds
    if mapped:
        figures["first_mapping_s"] = mapped[0]["mapping_ms"] / 1e3
    if later:
        total = sum(line["mapping_iterations"] for line in later)
        figures["mapping_ms_per_iteration"] = sum(line["mapping_ms"] for line in later) / total
        figures["mapping_iterations"] = later[-1]["mapping_iterations"]
    return figures


def _stage_times(log: list[dict[str, Any]], clock: RunClock) -> dict[str, float]:
    """Mean ms/frame of each stage. Waiting, the stages and `other_ms` add up to the loop's time; uploads overlap."""
    frames = max(clock.frames, 1)
    figures = {
        name: sum(line[name] for line in log) / frames
        for name in ("upload_ms", "wait_ms", "tracking_ms", "encode_ms", "mapping_ms")
    }
    spent_ms = sum(figures.values()) - figures["upload_ms"]
    return {**figures, "other_ms": max(1e3 * clock.wall_s / frames - spent_ms, 0.0)}
