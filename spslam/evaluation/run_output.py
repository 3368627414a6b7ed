"""Reads the files in the output folder of a run."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from spslam.camera import Camera
from spslam.datasets.images import check_image_size, read_color, read_depth
from spslam.errors import DatasetError, OutputError
from spslam.meshing import Mesh, load_mesh
from spslam.reading import MAX_JSON_BYTES, parse_json, read_lines, read_text
from spslam.run_folder import RunFolder
from spslam.trajectory import Trajectory

MAX_LOG_BYTES = 1 << 28  # 600 bytes per frame
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
        trajectory = _read_trajectory(folder.trajectory)
        return cls(
            folder,
            trajectory,
            _read_ground_truth(folder.preview_ground_truth, trajectory.timestamps),
            parse_json(_read_text(folder.metrics), str(folder.metrics), OutputError),
            _read_log(folder.log),
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
            mesh = load_mesh(path)
        except DatasetError as error:
            raise OutputError(str(error)) from None
        return mesh if len(mesh.faces) else None


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
    return read_text(path, MAX_JSON_BYTES, OutputError) if path.is_file() else ""


def _read_log(path: Path) -> list[dict[str, Any]]:
    if not path.is_file():
        return []
    return [parse_json(line, str(path), OutputError) for line in read_lines(path, OutputError, MAX_LOG_BYTES)]


def _read_trajectory(path: Path) -> Trajectory:
    try:
        return Trajectory.load_tum(path)
    except DatasetError as error:
        raise OutputError(str(error)) from None


def _read_camera(path: Path) -> Camera | None:
    if not path.is_file():
        return None
    values = parse_json(_read_text(path), str(path), OutputError)
    try:
        camera = Camera(**values)
        check_image_size((camera.width, camera.height), str(path))
        return camera
    except (TypeError, ValueError, DatasetError) as error:
        raise OutputError(f"{path}: must contain a camera: {error}") from error


def _read_ground_truth(path: Path, timestamps: np.ndarray) -> np.ndarray | None:
    if not path.is_file():
        return None
    ground_truth = _read_trajectory(path)
    poses = np.full((len(timestamps), 4, 4), np.nan)
    rows = match_times(ground_truth.timestamps, timestamps)
    poses[rows >= 0] = ground_truth.poses[rows[rows >= 0]]
    return poses if np.isfinite(poses).any() else None


def _read_preview(folder: RunFolder, row: int) -> Preview | None:
    depth_path = folder.depth_preview(row)
    try:
        color = read_color(folder.color_preview(row))
        size = color.shape[1], color.shape[0]
        depth = read_depth(depth_path, 1000.0, size=size) if depth_path.is_file() else None
    except DatasetError:
        return None
    return Preview(row, color, depth)
