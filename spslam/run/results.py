"""What a finished run writes: trajectory, map, mesh, metrics and report."""

import json
import resource
from typing import Any

import torch

from spslam.config import Config
from spslam.datasets.base import RgbdDataset
from spslam.errors import DatasetError
from spslam.evaluation.trajectory_metrics import ate, rpe
from spslam.io import atomic_write
from spslam.run.clock import RunClock
from spslam.run.provenance import provenance
from spslam.run.request import RunRequest
from spslam.run.session import RunSession
from spslam.slam.system import SlamSystem


def write_results(system: SlamSystem, dataset: RgbdDataset, request: RunRequest, session: RunSession) -> dict[str, Any]:
    """Writes all results and then removes the checkpoint, as there is nothing left to resume.

    Args:
        system: after the last frame.
        dataset: of the run.
        request: of the run; says whether a mesh is wanted.
        session: with the output folder and the clock of the whole run.

    Returns:
        What is written to metrics.json.

    Raises:
        SpslamError: there is no frame, all frames are lost, or a file can't be written.
    """
    config, folder, clock = request.config, session.folder, session.clock
    frames, skipped = system.state.frames, folder.read_skipped()
    if len(frames) == 0:
        raise DatasetError(f"{dataset.name}: no frame could be read; the first: {skipped[0]['error']}")
    trajectory, ground_truth, log = system.trajectory(), dataset.poses(), folder.read_log()
    lost = trajectory.lost
    if lost.all():
        raise DatasetError(_nothing_known(dataset, config))
    trajectory.save_tum(folder.trajectory)
    system.state.scene.save(folder.map)
    metrics = {
        **provenance(config, system.device),
        "data": session.identity,
        "frames": len(frames),
        **_speed(clock),
        **_timings(log, clock),
        "lost_frames": int(lost.sum()),
        "tracking_failures": int((lost[1:] & ~lost[:-1]).sum()) + int(lost[0]),
        "recovered_frames": sum(line["recovered"] for line in log),
        "relocalized_frames": sum(line["relocalized"] for line in log),
        **_max_error_probability(log),
        "skipped_frames": len(skipped),
        **_sizes(system),
    }
    if ground_truth is not None:
        known = trajectory.mask_lost(ground_truth[frames.indices.numpy()])
        metrics |= {**ate(trajectory.poses, known), **rpe(trajectory.poses, known)}
    if request.mesh:
        tracked = trajectory.poses[~lost]
        metrics["mesh_s"] = folder.write_mesh(system.state.scene, config.mesh.resolution_m, system.camera, tracked)
    atomic_write(folder.metrics, json.dumps(metrics, indent=1) + "\n")
    folder.write_previews(dataset, frames.indices.tolist(), ground_truth, config.run.previews)
    folder.write_report()
    folder.checkpoint.unlink(missing_ok=True)
    return metrics


def _nothing_known(dataset: RgbdDataset, config: Config) -> str:
    depth = config.dataset
    return (
        f"{dataset.name}: all frames are lost: none shows a surface between dataset.min_depth_m "
        f"({depth.min_depth_m:g} m) and dataset.max_depth_m ({depth.max_depth_m:g} m) in at least "
        f"tracking.min_valid_depth_share ({config.tracking.min_valid_depth_share:g}) of its pixels; "
        "`spslam check-data` shows what the depth images hold"
    )


def _max_error_probability(log: list[dict[str, Any]]) -> dict[str, float]:
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
    if system.device.type == "cuda":
        sizes["peak_gpu_mb"] = torch.cuda.max_memory_allocated(system.device) / 2**20
    return sizes


def _timings(log: list[dict[str, Any]], clock: RunClock) -> dict[str, float]:
    """Timings of metrics.json from the log: the stages' share of the loop, and time per iteration."""
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
