"""Creating, appending to and reading back a run's output folder."""

import json
import time
from pathlib import Path
from typing import IO, Any

import cv2
import numpy as np

from spslam.camera import Camera
from spslam.datasets.base import RgbdDataset
from spslam.errors import DatasetError, OutputError
from spslam.evaluation.html_report import write_report
from spslam.io import atomic_write
from spslam.meshing import extract_mesh, save_mesh
from spslam.run_folder import RunFolder
from spslam.scene import Scene
from spslam.trajectory import Trajectory


class OutputFolder(RunFolder):
    """The output folder of the run in progress."""

    def create(self, resume: bool) -> None:
        """Creates the folder for a new run.

        Args:
            resume: also accept a folder whose run ended before its first checkpoint; its files are removed.

        Raises:
            OutputError: the path is a file, or the folder has other content.
        """
        if self.path.exists() and not self.path.is_dir():
            raise OutputError(f"{self.path}: is a file, not a folder for results")
        if self.metrics.exists():
            raise OutputError(f"{self.path}: holds a finished run; use another --output")
        if self.checkpoint.exists():
            raise OutputError(f"{self.path}: holds an interrupted run; go on with --resume, or use another --output")
        if self.config.exists() and not resume:
            raise OutputError(
                f"{self.path}: holds a run that ended before its first checkpoint; "
                "start it over with --resume, or use another --output"
            )
        try:
            self.path.mkdir(parents=True, exist_ok=True)
            self.remove_temporaries()
            if any(self.path.iterdir()) and not self.config.exists():
                raise OutputError(f"{self.path}: is not empty; use another --output")
            for earlier in self.files():
                # config.yaml marks the folder as a run's; it is overwritten next.
                if earlier != self.config:
                    earlier.unlink(missing_ok=True)
        except OSError as error:
            raise OutputError(f"{self.path}: can't be made: {error.strerror or error}") from None

    def remove_temporaries(self) -> None:
        """Removes the temporary files of a killed run (see `spslam.io.atomic_write`)."""
        for path in self.files():
            for temporary in self.path.glob(f".{path.stem}.*.tmp{path.suffix}"):
                temporary.unlink(missing_ok=True)

    def open_log(self) -> IO[str]:
        """Opens the log to append lines; each line is written out at once."""
        return self.log.open("a", encoding="utf-8", buffering=1)

    def read_log(self) -> list[dict[str, Any]]:
        """The lines of the log."""
        return [json.loads(line) for line in self.log.read_text(encoding="utf-8").splitlines()]

    def truncate_log(self, frames: int, position: int) -> None:
        """Drops what an interrupted run logged after its last checkpoint.

        Args:
            frames: number of frames processed before the checkpoint.
            position: in the data set, of the first frame after the checkpoint.
        """
        atomic_write(self.log, "".join(_complete_lines(self.log)[:frames]))
        if self.skipped.exists():
            kept = [line for line in _complete_lines(self.skipped) if json.loads(line)["position"] < position]
            atomic_write(self.skipped, "".join(kept))

    def record_skipped(self, position: int, error: DatasetError) -> None:
        """Logs a frame that could not be read."""
        with self.skipped.open("a", encoding="utf-8") as file:
            file.write(json.dumps({"position": position, "error": str(error)}) + "\n")

    def read_skipped(self) -> list[dict[str, Any]]:
        """Position and error of the frames that could not be read, in order."""
        return [json.loads(line) for line in _complete_lines(self.skipped)]

    def write_mesh(self, scene: Scene, resolution_m: float, camera: Camera, poses: np.ndarray) -> float:
        """Extracts and writes the mesh.

        Args:
            scene: the map.
            resolution_m: edge of a marching-cubes cell, in meters.
            camera: intrinsics of the frames.
            poses: float64 [F, 4, 4] T_world_camera; surface that none of them sees is left out.

        Returns:
            Seconds taken.
        """
        started = time.perf_counter()
        save_mesh(extract_mesh(scene, resolution_m, camera, poses), self.mesh)
        return time.perf_counter() - started

    def write_previews(
        self, dataset: RgbdDataset, indices: list[int], ground_truth: np.ndarray | None, count: int
    ) -> None:
        """Writes what the report shows of the input: camera, ground truth and some frames.

        Args:
            dataset: of the run.
            indices: index in the data set of each row of the trajectory.
            ground_truth: float64 [len(dataset), 4, 4], NaN where unknown; None if there is none.
            count: number of frames, spread evenly over the run.
        """
        self.previews.mkdir(exist_ok=True)
        atomic_write(self.preview_camera, json.dumps(vars(dataset.camera)) + "\n")
        if ground_truth is not None:
            known = np.isfinite(ground_truth).all((1, 2))
            Trajectory(dataset.timestamps()[known], ground_truth[known]).save_tum(self.preview_ground_truth)
        for row in np.unique(np.linspace(0, len(indices) - 1, count).round().astype(int)).tolist():
            frame = dataset[indices[row]]
            millimeters = np.nan_to_num(np.rint(1000 * frame.depth), nan=0.0)
            depth = np.clip(millimeters, 0, np.iinfo(np.uint16).max).astype(np.uint16)
            _write_png(self.color_preview(row), cv2.cvtColor(frame.color, cv2.COLOR_RGB2BGR))
            _write_png(self.depth_preview(row), depth)

    def write_report(self) -> None:
        """Writes the report from the other files."""
        write_report(self.path)


def _complete_lines(path: Path) -> list[str]:
    """Lines with their ends, without a last one that a killed run wrote in part; none where there is no file."""
    if not path.exists():
        return []
    return [line for line in path.read_text(encoding="utf-8").splitlines(keepends=True) if line.endswith("\n")]


def _write_png(path: Path, image: np.ndarray) -> None:
    atomic_write(path, cv2.imencode(".png", image)[1].tobytes())
