"""Reading back what a run left in its output folder."""

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
from spslam.trajectory import Trajectory

MAX_LOG_BYTES = 1 << 28  # 600 bytes per frame
# Files keep a microsecond.
_SAME_TIME_S = 2e-6


@dataclass(frozen=True)
class Preview:
    """An input frame kept as pictures: its row in the trajectory, uint8 [H,W,3] RGB, float32 [H,W] meters or None."""

    row: int
    color: np.ndarray
    depth: np.ndarray | None


@dataclass(frozen=True)
class RunOutput:
    """A finished run's files.

    Attributes
    ----------
    folder : where they are.
    trajectory : estimated, F frames.
    truth : float64 [F,4,4] true poses of the same frames, NaN where unknown; None if none is known.
    metrics : what metrics.json holds.
    log : one entry a frame, as in log.jsonl.
    config : text of config.yaml.
    camera : None where the run kept no previews.
    """

    folder: Path
    trajectory: Trajectory
    ground_truth: np.ndarray | None
    metrics: dict[str, Any]
    log: list[dict[str, Any]]
    config: str
    camera: Camera | None

    @classmethod
    def read(cls, folder: Path) -> RunOutput:
        """Read a run's small files; trajectory.txt and metrics.json must be there.

        Raises
        ------
        OutputError
            When the folder is no finished run's, or a file in it is damaged.
        """
        for name in ("trajectory.txt", "metrics.json"):
            if not (folder / name).is_file():
                raise OutputError(f"{folder}: must be the output folder of a finished run, but has no {name}")
        trajectory = _read_trajectory(folder / "trajectory.txt")
        return cls(
            folder,
            trajectory,
            _read_ground_truth(folder / "previews" / "ground_truth.txt", trajectory.timestamps),
            parse_json(_read_text(folder / "metrics.json"), str(folder / "metrics.json"), OutputError),
            _read_log(folder / "log.jsonl"),
            _read_text(folder / "config.yaml"),
            _read_camera(folder / "previews" / "camera.json"),
        )

    @property
    def known_ground_truth(self) -> np.ndarray | None:
        """The true poses [F,4,4] of the frames whose pose the run knew, NaN for the others; None if none is known."""
        return None if self.ground_truth is None else self.trajectory.ground_truth_of_known(self.ground_truth)

    def previews(self) -> list[Preview]:
        """The kept input frames, by row; ones that can't be read, or whose pose isn't known, are left out."""
        found = (_read_preview(path) for path in sorted((self.folder / "previews").glob("frame-*.png")))
        return [preview for preview in found if preview is not None and self._is_known(preview.row)]

    def _is_known(self, row: int) -> bool:
        return row < len(self.trajectory) and not self.trajectory.lost[row]

    def mesh(self) -> Mesh | None:
        """mesh.ply; None where there is none or it is empty. Raises OutputError if it can't be read."""
        path = self.folder / "mesh.ply"
        if not path.is_file():
            return None
        try:
            mesh = load_mesh(path)
        except DatasetError as error:
            raise OutputError(str(error)) from None
        return mesh if len(mesh.faces) else None


def match_times(times: np.ndarray, wanted: np.ndarray) -> np.ndarray:
    """For each wanted time the index of the same one in ``times``, to the microsecond that files keep; -1 if absent."""
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
        raise OutputError(f"{path}: must hold a camera: {error}") from error


def _read_ground_truth(path: Path, timestamps: np.ndarray) -> np.ndarray | None:
    if not path.is_file():
        return None
    ground_truth = _read_trajectory(path)
    poses = np.full((len(timestamps), 4, 4), np.nan)
    rows = match_times(ground_truth.timestamps, timestamps)
    poses[rows >= 0] = ground_truth.poses[rows[rows >= 0]]
    return poses if np.isfinite(poses).any() else None


def _read_preview(path: Path) -> Preview | None:
    number = path.stem.removeprefix("frame-")
    if not number.isdecimal():
        return None
    depth_path = path.with_name(f"depth-{number}.png")
    try:
        color = read_color(path)
        size = color.shape[1], color.shape[0]
        depth = read_depth(depth_path, 1000.0, size=size) if depth_path.is_file() else None
    except DatasetError:
        return None
    return Preview(int(number), color, depth)
