"""What a finished run writes: trajectory, map, mesh, metrics and report."""

import json
import resource
from pathlib import Path
from typing import Any

import torch

from spslam import __version__
from spslam.config import Config
from spslam.datasets.base import RgbdDataset
from spslam.errors import DatasetError
from spslam.evaluation.trajectory_metrics import ate, rpe
from spslam.io import atomic_write
from spslam.run.output_folder import RunFiles
from spslam.slam.system import SlamSystem


def write_results(
    system: SlamSystem,
    dataset: RgbdDataset,
    config: Config,
    files: RunFiles,
    clock: dict[str, Any],
    mesh: bool,
) -> dict[str, Any]:
    """Writes everything; the checkpoint goes last, as from then on there is nothing to resume.

    Args:
        system: after the last frame.
        dataset: what the run was over.
        config: of the run.
        files: of its output folder.
        clock: `start_s` before the loop, `wall_s` of it, `decode_s` of reading, and the `frames` that they are for.
        mesh: whether to extract the mesh.

    Returns:
        What is written to metrics.json.

    Raises:
        SpslamError: there is no frame, or a file can't be written.
    """
    frames, skipped = system.state.frames, files.read_skipped()
    if len(frames) == 0:
        raise DatasetError(f"{dataset.name}: no frame could be read; the first: {skipped[0]['error']}")
    trajectory, ground_truth, log = system.trajectory(), dataset.poses(), files.read_log()
    lost = trajectory.lost
    trajectory.save_tum(files.trajectory)
    system.state.scene.save(files.map)
    metrics = {
        **provenance(config, system.device),
        "frames": len(frames),
        **_speed(clock),
        **_timings(log, clock),
        "lost_frames": int(lost.sum()),
        "tracking_failures": int((lost[1:] & ~lost[:-1]).sum()) + int(lost[0]),
        "recovered_frames": sum(line["recovered"] for line in log),
        "relocalized_frames": sum(line["relocalized"] for line in log),
        **_most_doubt(log),
        "skipped_frames": len(skipped),
        **_sizes(system),
    }
    if ground_truth is not None:
        known = trajectory.mask_lost(ground_truth[frames.indices.numpy()])
        metrics |= {**ate(trajectory.poses, known), **rpe(trajectory.poses, known)}
    if mesh:
        tracked = trajectory.poses[~lost]
        metrics["mesh_s"] = files.write_mesh(system.state.scene, config.mesh.resolution_m, system.camera, tracked)
    atomic_write(files.metrics, json.dumps(metrics, indent=1) + "\n")
    files.write_report(dataset, frames.indices.tolist(), ground_truth, config.run.previews)
    files.checkpoint.unlink(missing_ok=True)
    return metrics


def provenance(config: Config, device: torch.device) -> dict[str, Any]:
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


def _most_doubt(log: list[dict[str, Any]]) -> dict[str, float]:
    """The highest doubt about a pose that was taken."""
    error_probabilities = [
        line["error_probability"] for line in log if not line["lost"] and line["error_probability"] is not None
    ]
    return {"max_error_probability": max(error_probabilities)} if error_probabilities else {}


def _speed(clock: dict[str, Any]) -> dict[str, float]:
    frames, wall_s = clock["frames"], clock["wall_s"]
    return {
        "start_s": clock["start_s"],
        "wall_s": wall_s,
        "fps": frames / wall_s if wall_s else 0.0,
        "decode_ms": 1e3 * clock["decode_s"] / max(frames, 1),
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


def _timings(log: list[dict[str, Any]], clock: dict[str, Any]) -> dict[str, float]:
    """The timing figures of metrics.json, from the log: where a frame's time goes, and iterations by themselves."""
    tracked = [line for line in log if line["tracking_iterations"]]
    mapped = [line for line in log if line["mapping_iterations"]]
    later = mapped[1:]
    figures = _shares(log, clock)
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


def _shares(log: list[dict[str, Any]], clock: dict[str, Any]) -> dict[str, float]:
    """Milliseconds a frame, on average; waiting, the stages and the rest add up to the loop's time."""
    frames = max(clock["frames"], 1)
    figures = {
        name: sum(line[name] for line in log) / frames
        for name in ("upload_ms", "wait_ms", "tracking_ms", "encode_ms", "mapping_ms")
    }
    spent_ms = sum(figures.values()) - figures["upload_ms"]
    return {**figures, "other_ms": max(1e3 * clock["wall_s"] / frames - spent_ms, 0.0)}
