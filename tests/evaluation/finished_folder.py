"""A run's output folder without a run, for tests of what reads it."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import trimesh

from spslam.camera import Camera
from spslam.geometry import pose_from
from spslam.trajectory import Trajectory

CAMERA = Camera(64, 48, 55.0, 55.0, 31.5, 23.5)
FRAMES = 30
# first frame of each loss, and the first known one after it
LOSSES = ((12, 14),)


def trajectory_poses(frames: int = FRAMES) -> np.ndarray:
    """A walk forward of 1 m, slightly curved, in a box that is 8 m long."""
    steps = np.arange(frames) * 30 / max(frames, 30)
    return np.stack([pose_from(np.eye(3), np.array([0.02 * s, 0.01 * np.sin(s), 0.03 * s])) for s in steps])


def lost_frames(frames: int, losses: tuple[tuple[int, int], ...] = LOSSES) -> np.ndarray:
    """Which frames are lost, bool [F]."""
    lost = np.zeros(frames, bool)
    for first, end in losses:
        lost[first:end] = True
    return lost


def log_lines(frames: int, lost: np.ndarray, **measures: float) -> list[dict]:
    """Lines of log.jsonl.

    Args:
        frames: number of them.
        lost: bool [F].
        measures: of the lost frames, by their names in the log.
    """
    lines = []
    for i in range(frames):
        line = {"frame": i, "lost": bool(lost[i]),
                "tracking_ms": 9.0, "encode_ms": 0, "mapping_ms": 80.0 * (i % 5 == 0),
                "residual_cm": None if i == 0 else 0.5 + 0.1 * np.sin(i), "inlier_share": 0.9,
                "valid_depth_share": 0.8, "error_probability": None if i == 0 else 1e-4}  # fmt: skip
        if lost[i]:
            line |= {"error_probability": 0.99} | measures
        lines.append(line)
    return lines


def write_run(
    folder: Path,
    missing: tuple[str, ...] = (),
    frames: int = FRAMES,
    losses: tuple[tuple[int, int], ...] = LOSSES,
    **measures: float,
) -> Path:
    """Writes the files of a finished run in a box.

    Args:
        folder: to write into.
        missing: of `mesh`, `ground_truth`, `log`, `previews`, `config`: what is left out.
        frames: number of frames.
        losses: first frame of each loss, and the first known one after it.
        measures: of the lost frames, by their names in the log.

    Returns:
        The folder.
    """
    folder.mkdir(exist_ok=True)
    times, poses, lost = np.arange(frames) / 30, trajectory_poses(frames), lost_frames(frames, losses)
    Trajectory(times, poses, lost).save_tum(folder / "trajectory.txt")
    metrics = {"frames": frames, "fps": 12.5, "ate_rmse_cm": 1.25, "wall_s": 3.0, "device_name": "<processor & co>"}
    if "ground_truth" in missing:
        del metrics["ate_rmse_cm"]
    (folder / "metrics.json").write_text(json.dumps(metrics))
    if not {"previews", "ground_truth"} <= set(missing):
        (folder / "previews").mkdir(exist_ok=True)
        (folder / "previews" / "camera.json").write_text(json.dumps(vars(CAMERA)))
    if "ground_truth" not in missing:
        moved = pose_from(np.array([[0.0, 0, 1], [0, 1, 0], [-1, 0, 0]]), np.array([1.0, 2, 3])) @ poses
        Trajectory(times[::2], moved[::2]).save_tum(folder / "previews" / "ground_truth.txt")
    if "previews" not in missing:
        for row in {0, frames - 1}:
            cv2.imwrite(str(folder / "previews" / f"frame-{row:06d}.png"), np.full((48, 64, 3), 99, np.uint8))
        cv2.imwrite(str(folder / "previews" / "depth-000000.png"), np.full((48, 64), 2000, np.uint16))
    if "mesh" not in missing:
        room = trimesh.creation.box((8, 6, 8)).subdivide().subdivide().subdivide()
        shade = np.rint(127 + 120 * np.sin(room.vertices)).astype(np.uint8)
        room.visual.vertex_colors = np.column_stack([shade, np.full(len(shade), 255, np.uint8)])
        room.export(folder / "mesh.ply")
    if "log" not in missing:
        lines = log_lines(frames, lost, **measures)
        (folder / "log.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
    if "config" not in missing:
        (folder / "config.yaml").write_text("# a <comment>\ndataset:\n  type: folder\n  path: data\n")
    return folder
