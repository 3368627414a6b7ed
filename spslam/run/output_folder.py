"""The files that a run leaves in its output folder."""

import json
import time
from pathlib import Path
from typing import IO

import cv2
import numpy as np

from spslam.camera import Camera
from spslam.datasets.base import RgbdDataset
from spslam.errors import DatasetError, OutputError
from spslam.evaluation.html_report import write_report
from spslam.io import atomic_write
from spslam.meshing import extract_mesh, save_mesh
from spslam.scene import Scene
from spslam.trajectory import Trajectory


class RunFiles:
    """Names, makes and reads the files of one output folder."""

    def __init__(self, folder: Path):
        self.folder = Path(folder)
        self.checkpoint = self.folder / "checkpoint.safetensors"
        self.config = self.folder / "config.yaml"
        self.log = self.folder / "log.jsonl"
        self.map = self.folder / "map.safetensors"
        self.mesh = self.folder / "mesh.ply"
        self.metrics = self.folder / "metrics.json"
        self.previews = self.folder / "previews"
        self.report = self.folder / "report.html"
        self.skipped = self.folder / "skipped.jsonl"
        self.trajectory = self.folder / "trajectory.txt"

    def create(self, resume: bool) -> None:
        """Makes the folder for a new run; with `resume`, also over what a run left that had no checkpoint yet.

        Raises:
            OutputError: it is a file, or holds something already.
        """
        if self.folder.exists() and not self.folder.is_dir():
            raise OutputError(f"{self.folder}: is a file, not a folder for results")
        if self.metrics.exists():
            raise OutputError(f"{self.folder}: holds a finished run; use another --output")
        if self.checkpoint.exists():
            raise OutputError(f"{self.folder}: holds an interrupted run; go on with --resume, or use another --output")
        if self.config.exists() and not resume:
            raise OutputError(
                f"{self.folder}: holds a run that ended before its first checkpoint; "
                "start it over with --resume, or use another --output"
            )
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            self.remove_temporaries()
            if any(self.folder.iterdir()) and not self.config.exists():
                raise OutputError(f"{self.folder}: is not empty; use another --output")
            for earlier in (self.log, self.skipped, self.trajectory, self.map, self.mesh, self.report):
                earlier.unlink(missing_ok=True)
        except OSError as error:
            raise OutputError(f"{self.folder}: can't be made: {error.strerror or error}") from None

    def remove_temporaries(self) -> None:
        """Removes what a killed run was just writing (see `spslam.io.atomic_write`)."""
        for path in (self.checkpoint, self.config, self.log, self.map, self.mesh, self.metrics, self.trajectory):
            for temporary in self.folder.glob(f".{path.stem}.*.tmp{path.suffix}"):
                temporary.unlink(missing_ok=True)

    def open_log(self) -> IO[str]:
        """The log, to append lines to; each is written out at once."""
        return self.log.open("a", encoding="utf-8", buffering=1)

    def read_log(self) -> list[dict]:
        """The log's lines."""
        return [json.loads(line) for line in self.log.read_text(encoding="utf-8").splitlines()]

    def keep_log(self, frames: int, position: int) -> None:
        """Drops what an interrupted run noted after its last checkpoint.

        Args:
            frames: how many were processed up to there.
            position: of the next frame to read.
        """
        atomic_write(self.log, "".join(_whole_lines(self.log)[:frames]))
        if self.skipped.exists():
            kept = [line for line in _whole_lines(self.skipped) if json.loads(line)["position"] < position]
            atomic_write(self.skipped, "".join(kept))

    def record_skipped(self, position: int, error: DatasetError) -> None:
        """Notes a frame that could not be read."""
        with self.skipped.open("a", encoding="utf-8") as file:
            file.write(json.dumps({"position": position, "error": str(error)}) + "\n")

    def read_skipped(self) -> list[dict]:
        """The frames that could not be read: position in the data set and error, in order."""
        return [json.loads(line) for line in _whole_lines(self.skipped)]

    def write_mesh(self, scene: Scene, resolution_m: float, camera: Camera, poses: np.ndarray) -> float:
        """Extracts and writes the mesh; returns the seconds that took."""
        started = time.perf_counter()
        save_mesh(extract_mesh(scene, resolution_m, camera, poses), self.mesh)
        return time.perf_counter() - started

    def write_previews(
        self, dataset: RgbdDataset, indices: list[int], ground_truth: np.ndarray | None, count: int
    ) -> None:
        """Keeps `count` input frames (depth as 16-bit millimeters), the camera and the true path, for the report."""
        self.previews.mkdir(exist_ok=True)
        camera = dataset.camera
        atomic_write(self.previews / "camera.json", json.dumps(vars(camera)) + "\n")
        if ground_truth is not None:
            known = np.isfinite(ground_truth).all((1, 2))
            Trajectory(dataset.timestamps()[known], ground_truth[known]).save_tum(self.previews / "ground_truth.txt")
        for row in np.unique(np.linspace(0, len(indices) - 1, count).round().astype(int)).tolist():
            frame = dataset[indices[row]]
            millimeters = np.nan_to_num(np.rint(1000 * frame.depth), nan=0.0)
            depth = np.clip(millimeters, 0, np.iinfo(np.uint16).max).astype(np.uint16)
            _write_png(self.previews / f"frame-{row:06d}.png", cv2.cvtColor(frame.color, cv2.COLOR_RGB2BGR))
            _write_png(self.previews / f"depth-{row:06d}.png", depth)

    def write_report(
        self, dataset: RgbdDataset, indices: list[int], ground_truth: np.ndarray | None, previews: int
    ) -> None:
        """Writes report.html from the other files."""
        self.write_previews(dataset, indices, ground_truth, previews)
        write_report(self.folder)


def _whole_lines(path: Path) -> list[str]:
    """Lines of a file, with their ends, without one that was being written as the run was killed; none, if no file."""
    if not path.exists():
        return []
    return [line for line in path.read_text(encoding="utf-8").splitlines(keepends=True) if line.endswith("\n")]


def _write_png(path: Path, image: np.ndarray) -> None:
    atomic_write(path, cv2.imencode(".png", image)[1].tobytes())
