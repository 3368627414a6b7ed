"""Reads the files in the output folder of a run."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import trimesh

from spslam.camera import Camera
from spslam.errors import OutputError
from spslam.run_folder import RunFolder
from spslam.trajectory import Trajectory

# Timestamps in files have a resolution of 1 microsecond.
_SAME_TIME_S = 2e-6


@dataclass(frozen=True)
class Preview:
    """A saved input frame.

    Attributes:
        row: its row in the trajectory.
        color: uint8 [H, W, 3] RGB.
        depth: float32 [H, W], meters, or None.
    """

    row: int
    color: np.ndarray
    depth: np.ndarray | None


@dataclass(frozen=True)
class Mesh:
    """A mesh as read from a file.

    Attributes:
        vertices: [V, 3], meters.
        faces: [L, 3].
        colors: uint8 [V, 3] RGB.
    """

    vertices: np.ndarray
    faces: np.ndarray
    colors: np.ndarray


@dataclass(frozen=True)
class RunOutput:
    """The output of a finished run.

    Attributes:
        folder: paths of its files.
        trajectory: estimated trajectory, F frames.
        ground_truth: float64 [F, 4, 4] ground-truth poses of the same frames, NaN where unknown; None without any.
        metrics: content of metrics.json.
        log: one entry per frame, as in log.jsonl.
        config: text of config.yaml.
        camera: intrinsics; None if the run saved no previews.
    """

    folder: RunFolder
    trajectory: Trajectory
    ground_truth: np.ndarray | None
    metrics: dict[str, Any]
    log: list[dict[str, Any]]
    config: str
    camera: Camera | None

    @classmethod
    def read(cls, path: Path) -> RunOutput:
        """Reads an output folder, except its mesh and previews; trajectory.txt and metrics.json must exist.

        Raises:
            OutputError: the folder is not the output folder of a finished run, or a file in it is damaged.
        """
        folder = RunFolder(path)
        for required in (folder.trajectory, folder.metrics):
            if not required.is_file():
                raise OutputError(f"{path}: must be the output folder of a finished run, but has no {required.name}")
        trajectory = Trajectory.load_tum(folder.trajectory)
        return cls(
            folder,
            trajectory,
            _read_ground_truth(folder.preview_ground_truth, trajectory.timestamps),
            _parse(folder.metrics, _read_text(folder.metrics)),
            [_parse(folder.log, line) for line in _read_text(folder.log).splitlines()],
            _read_text(folder.config),
            _read_camera(folder.preview_camera),
        )

    @property
    def known_ground_truth(self) -> np.ndarray | None:
        """Ground-truth poses [F, 4, 4], NaN for lost frames and where unknown; None without any."""
        return None if self.ground_truth is None else self.trajectory.mask_lost(self.ground_truth)

    def previews(self) -> list[Preview]:
        """The saved input frames in order; unreadable ones and lost frames are left out."""
        found = (_read_preview(self.folder, row) for row in self.folder.preview_rows() if self._is_known(row))
        return [preview for preview in found if preview is not None]

    def _is_known(self, row: int) -> bool:
        return row < len(self.trajectory) and not self.trajectory.lost[row]

    def mesh(self) -> Mesh | None:
        """Reads mesh.ply; None if it does not exist or is empty.

        Raises:
            OutputError: the file cannot be read.
        """
        path = self.folder.mesh
        if not path.is_file():
            return None
        try:
            mesh = trimesh.load(path, process=False)
        except Exception as error:  # trimesh raises errors of many types
            raise OutputError(f"{path}: can't be read as a mesh: {error}") from error
        if not isinstance(mesh, trimesh.Trimesh) or not len(mesh.faces):
            return None
        colors = np.asarray(mesh.visual.vertex_colors)[:, :3]  # type: ignore[union-attr]
        return Mesh(np.asarray(mesh.vertices), np.asarray(mesh.faces), colors)


def match_times(times: np.ndarray, wanted: np.ndarray) -> np.ndarray:
    """Index in `times` of each wanted timestamp, -1 if it is missing; equal up to the resolution of files.

    Args:
        times: [N], seconds.
        wanted: [M], seconds.

    Returns:
        Integers [M].
    """
    if not len(times):
        return np.full(len(wanted), -1)
    order = np.argsort(times, kind="stable")
    after = np.clip(np.searchsorted(times[order], wanted), 1, max(len(times) - 1, 1)).clip(max=len(times) - 1)
    before = np.maximum(after - 1, 0)
    nearer = np.where(np.abs(times[order[before]] - wanted) <= np.abs(times[order[after]] - wanted), before, after)
    found = order[nearer]
    return np.where(np.abs(times[found] - wanted) <= _SAME_TIME_S, found, -1)


def _read_text(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8") if path.is_file() else ""
    except (OSError, UnicodeDecodeError) as error:
        raise OutputError(f"{path}: can't be read: {error}") from error


def _parse(path: Path, text: str) -> dict[str, Any]:
    try:
        value = json.loads(text)
    except ValueError as error:
        raise OutputError(f"{path}: must be JSON: {error}") from error
    if not isinstance(value, dict):
        raise OutputError(f"{path}: must contain a JSON object, got {type(value).__name__}")
    return value


def _read_camera(path: Path) -> Camera | None:
    if not path.is_file():
        return None
    values = _parse(path, _read_text(path))
    try:
        return Camera(**values)
    except (TypeError, ValueError) as error:
        raise OutputError(f"{path}: must contain a camera: {error}") from error


def _read_ground_truth(path: Path, timestamps: np.ndarray) -> np.ndarray | None:
    if not path.is_file():
        return None
    ground_truth = Trajectory.load_tum(path)
    poses = np.full((len(timestamps), 4, 4), np.nan)
    rows = match_times(ground_truth.timestamps, timestamps)
    poses[rows >= 0] = ground_truth.poses[rows[rows >= 0]]
    return poses if np.isfinite(poses).any() else None


def _read_preview(folder: RunFolder, row: int) -> Preview | None:
    color = cv2.imread(str(folder.color_preview(row)), cv2.IMREAD_COLOR)
    if color is None:
        return None
    depth_path = folder.depth_preview(row)
    depth = cv2.imread(str(depth_path), cv2.IMREAD_UNCHANGED) if depth_path.is_file() else None
    meters = None if depth is None else depth.astype(np.float32) / 1000
    return Preview(row, cv2.cvtColor(color, cv2.COLOR_BGR2RGB), meters)
