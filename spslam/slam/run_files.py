"""The files that a run leaves in its output folder."""

import json
import time
from pathlib import Path
from typing import IO

import cv2
import numpy as np

from spslam.datasets.base import RgbdDataset
from spslam.errors import DatasetError, OutputError
from spslam.evaluation.report import write_report
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
        """Makes the folder for a new run.

        Raises:
            OutputError: it is a file, or holds something already.
        """
        if self.folder.exists() and not self.folder.is_dir():
            raise OutputError(f"{self.folder}: is a file, not a folder for results")
        if self.metrics.exists():
            raise OutputError(f"{self.folder}: holds a finished run; use another --output")
        if self.checkpoint.exists() and not resume:
            raise OutputError(f"{self.folder}: holds an interrupted run; go on with --resume, or use another --output")
        started_over = resume and self.config.exists()
        if self.folder.exists() and any(self.folder.iterdir()) and not started_over:
            raise OutputError(f"{self.folder}: is not empty; use another --output")
        try:
            self.folder.mkdir(parents=True, exist_ok=True)
            for stale in (self.log, self.skipped):
                stale.unlink(missing_ok=True)
        except OSError as error:
            raise OutputError(f"{self.folder}: can't be made: {error.strerror or error}") from None

    def open_log(self) -> IO[str]:
        """The log, to append lines to."""
        return self.log.open("a", encoding="utf-8")

    def read_log(self) -> list[dict]:
        """The log's lines."""
        return [json.loads(line) for line in self.log.read_text(encoding="utf-8").splitlines()]

    def keep_log_lines(self, count: int) -> None:
        """Drops the lines that an interrupted run wrote after its last checkpoint."""
        lines = self.log.read_text(encoding="utf-8").splitlines(keepends=True) if self.log.exists() else []
        atomic_write(self.log, "".join(lines[:count]))

    def record_skipped(self, position: int, error: DatasetError) -> None:
        """Notes a frame that could not be read."""
        with self.skipped.open("a", encoding="utf-8") as file:
            file.write(json.dumps({"position": position, "error": str(error)}) + "\n")

    def count_skipped(self) -> int:
        """How many frames could not be read."""
        return len({line["position"] for line in self._skipped()})

    def first_skipped(self) -> str:
        """Why the first of them could not."""
        return next((line["error"] for line in self._skipped()), "none")

    def write_mesh(self, scene: Scene, resolution_m: float) -> float:
        """Extracts and writes the mesh; returns the seconds that took."""
        started = time.perf_counter()
        save_mesh(extract_mesh(scene, resolution_m), self.mesh)
        return time.perf_counter() - started

    def write_previews(self, dataset: RgbdDataset, indices: list[int], truth: np.ndarray | None, count: int) -> None:
        """Keeps `count` input frames (depth as 16-bit millimetres), the camera and the true path, for the report."""
        self.previews.mkdir(exist_ok=True)
        camera = dataset.camera
        atomic_write(self.previews / "camera.json", json.dumps(vars(camera)) + "\n")
        if truth is not None:
            known = np.isfinite(truth).all((1, 2))
            Trajectory(dataset.timestamps()[known], truth[known]).save_tum(self.previews / "truth.txt")
        for row in np.unique(np.linspace(0, len(indices) - 1, count).round().astype(int)).tolist():
            frame = dataset[indices[row]]
            depth = np.clip(np.rint(1000 * frame.depth), 0, np.iinfo(np.uint16).max).astype(np.uint16)
            _write_png(self.previews / f"frame-{row:06d}.png", cv2.cvtColor(frame.color, cv2.COLOR_RGB2BGR))
            _write_png(self.previews / f"depth-{row:06d}.png", depth)

    def write_report(self, dataset: RgbdDataset, indices: list[int], truth: np.ndarray | None, previews: int) -> None:
        """Writes report.html from the other files."""
        self.write_previews(dataset, indices, truth, previews)
        write_report(self.folder)

    def _skipped(self) -> list[dict]:
        if not self.skipped.exists():
            return []
        return [json.loads(line) for line in self.skipped.read_text(encoding="utf-8").splitlines()]


def _write_png(path: Path, image: np.ndarray) -> None:
    atomic_write(path, cv2.imencode(".png", image)[1].tobytes())
