"""What metrics.json says, by what it is measured on: the same of a run in one piece, in chunks, and of joined maps."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch

from spslam.config import Config
from spslam.evaluation.trajectory_metrics import ate, rpe
from spslam.run.clock import RunClock
from spslam.run.mesh import noise_of_model
from spslam.run.provenance import provenance
from spslam.scene import Scene
from spslam.slam.graph.edges import GraphEdge
from spslam.trajectory import Trajectory

Log = Sequence[dict[str, Any]]

TIMING_FIGURES = ("color_delay_ms", "readout_ms")


def origin(config: Config, device: torch.device, command: str) -> dict[str, Any]:
    """By what something was made.

    Args:
        config: its options.
        device: that it was made on.
        command: the command line; empty where there was none.
    """
    return {**provenance(config, device), **({"command": command} if command else {})}


def tracking_figures(trajectory: Trajectory, log: Log) -> dict[str, Any]:
    """How tracking went, from the trajectory and the lines of log.jsonl."""
    lost = trajectory.lost
    accepted = [line["error_probability"] for line in log if not line["lost"] and line["error_probability"] is not None]
    return {
        "lost_frames": int(lost.sum()),
        "tracking_failures": int((lost[1:] & ~lost[:-1]).sum()) + int(lost[0]),
        "recovered_frames": sum(line["recovered"] for line in log),
        "relocalized_frames": sum(line["relocalized"] for line in log),
        **({"max_error_probability": max(accepted)} if accepted else {}),
    }


def truth_figures(trajectory: Trajectory, poses: np.ndarray | None) -> dict[str, Any]:
    """Errors of a trajectory against ground truth; or what is unchecked without it.

    Args:
        trajectory: F frames.
        poses: float64 [F, 4, 4] ground truth, NaN where unknown; None if there is none.
    """
    figures: dict[str, Any] = {}
    if poses is not None:
        known = trajectory.mask_lost(poses)
        figures = {**ate(trajectory.poses, known), **rpe(trajectory.poses, known)}
    if "ate_rmse_cm" not in figures:
        figures["unchecked"] = ["error", "depth scale", "mirrored images"]
    return figures


def scene_figures(scene: Scene) -> dict[str, Any]:
    """The size of a map."""
    return {"voxels": scene.volume.num_voxels, "model_mb": scene.nbytes / 2**20}


def graph_figures(keyframes: int, edges: Sequence[GraphEdge]) -> dict[str, int]:
    """The size of a keyframe graph."""
    kinds = [edge.kind for edge in edges]
    return {"keyframes": keyframes, "graph_edges": len(kinds), "closed_loops": kinds.count("loop")}


def noise_figures(model: torch.Tensor) -> dict[str, float]:
    """What was measured of a sensor's noise, float32 [4]."""
    floor, growth = noise_of_model(model)
    return {"depth_noise_floor_m2": floor, "depth_noise_growth_m2": growth}


def timing_figures(color_delay: torch.Tensor, readout: torch.Tensor) -> dict[str, float]:
    """When the sensor took its images, as was measured: float32 [1] each, s."""
    return dict(zip(TIMING_FIGURES, (1e3 * float(color_delay), 1e3 * float(readout)), strict=True))


def decoding_figures(clock: RunClock) -> dict[str, float]:
    """Time of decoding."""
    return {"decode_ms": 1e3 * clock.decode_s / max(clock.frames, 1)}


def timings(log: Log, clock: RunClock) -> dict[str, float]:
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


def _stage_times(log: Log, clock: RunClock) -> dict[str, float]:
    """Mean ms/frame of each stage. Waiting, the stages and `other_ms` add up to the loop's time; uploads overlap."""
    frames = max(clock.frames, 1)
    figures = {
        name: sum(line[name] for line in log) / frames
        for name in ("upload_ms", "wait_ms", "tracking_ms", "encode_ms", "mapping_ms")
    }
    spent_ms = sum(figures.values()) - figures["upload_ms"]
    return {**figures, "other_ms": max(1e3 * clock.wall_s / frames - spent_ms, 0.0)}
