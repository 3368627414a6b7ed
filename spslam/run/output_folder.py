"""Creating, appending to and reading back a run's output folder."""

import contextlib
import errno
import fcntl
import itertools
import json
import os
import shutil
from collections.abc import Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from types import TracebackType
from typing import Any

import cv2
import numpy as np

from spslam.camera import Camera
from spslam.datasets.base import RgbdFrame
from spslam.datasets.prefetch import usable_cores
from spslam.errors import DatasetError, OutputError
from spslam.io import atomic_write, writing
from spslam.run.chunk_options import ChunkPlan
from spslam.run_folder import RunFolder
from spslam.trajectory import Trajectory

# Error codes of flock on file systems without locks.
_NO_LOCKS = (errno.ENOLCK, errno.ENOTSUP, errno.EBADF)
_PREVIEW_THREADS = 4  # that encode images, one frame each


class RunLog(contextlib.AbstractContextManager):
    """log.jsonl, open to append rows, which are written out at once.

    Raises:
        OutputError: the file can't be written.
    """

    def __init__(self, path: Path):
        self.path = path
        with writing(path):
            self._file = path.open("a", encoding="utf-8")

    def append(self, rows: Sequence[dict[str, Any]]) -> None:
        """Adds rows."""
        if rows:
            with writing(self.path):
                self._file.write("".join(json.dumps(row) + "\n" for row in rows))
                self._file.flush()

    def sync(self) -> None:
        """Returns when all rows are on the disk."""
        with writing(self.path):
            os.fsync(self._file.fileno())

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        if error is None:
            with writing(self.path):
                self._file.close()
        else:
            with contextlib.suppress(OSError):  # of a row that could not be written, which was reported already
                self._file.close()


class OutputFolder(RunFolder):
    """The output folder of the run in progress."""

    @contextlib.contextmanager
    def locked(self) -> Iterator[None]:
        """Makes the folder where there is none, and keeps other runs out of it; the lock ends with the process.

        Raises:
            OutputError: the path is a file, the folder can't be made, or another run is writing into it.
        """
        if self.path.exists() and not self.path.is_dir():
            raise OutputError(f"{self.path}: is a file, not a folder for results")
        try:
            self.path.mkdir(parents=True, exist_ok=True)
            descriptor = os.open(self.path, os.O_RDONLY)
        except OSError as error:
            raise OutputError(f"{self.path}: can't be made: {error.strerror or error}") from None
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            os.close(descriptor)
            raise OutputError(
                f"{self.path}: another run is writing into it; wait for its end, or use another --output"
            ) from None
        except OSError as error:
            if error.errno not in _NO_LOCKS:
                os.close(descriptor)
                raise OutputError(f"{self.path}: can't be locked: {error.strerror or error}") from None
        try:
            yield
        finally:
            os.close(descriptor)

    def create(self, resume: bool) -> None:
        """Prepares the locked folder for a new run.

        Args:
            resume: also accept a folder whose run ended before its first checkpoint; its files are removed.

        Raises:
            OutputError: the folder has other content.
        """
        plan = ChunkPlan.read(self)
        if plan is not None:
            raise plan.to_be_continued(self)
        if self.metrics.exists():
            raise OutputError(f"{self.path}: holds a finished run; use another --output")
        if self.checkpoint.exists():
            raise OutputError(
                f"{self.path}: contains an interrupted run; continue it with --resume, or use another --output"
            )
        if self.config.exists() and not resume:
            raise OutputError(
                f"{self.path}: holds a run that ended before its first checkpoint; "
                "start it over with --resume, or use another --output"
            )
        with self._being_emptied():
            self.remove_temporaries()
            if any(self.path.iterdir()) and not self.config.exists():
                raise OutputError(f"{self.path}: is not empty; use another --output")
        self.clear()

    def clear(self) -> None:
        """Removes what a run has written, but for the configuration, which marks the folder as a run's.

        Raises:
            OutputError: it can't be removed.
        """
        with self._being_emptied():
            self.remove_temporaries()
            for earlier in self.files():
                if earlier != self.config:
                    earlier.unlink(missing_ok=True)
            shutil.rmtree(self.previews, ignore_errors=True)

    @contextlib.contextmanager
    def _being_emptied(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            raise OutputError(f"{self.path}: can't be emptied: {error.strerror or error}") from None

    def remove_temporaries(self) -> None:
        """Removes the temporary files of a killed run (see `spslam.io.atomic_write`)."""
        for path in self.files():
            for temporary in self.path.glob(f".{path.stem}.*.tmp{path.suffix}"):
                temporary.unlink(missing_ok=True)
        for temporary in self.previews.glob(".*.tmp.*"):
            temporary.unlink(missing_ok=True)

    def read_log(self) -> list[dict[str, Any]]:
        """The lines of the log; raises OutputError where one is damaged."""
        try:
            return [json.loads(line) for line in self.log.read_text(encoding="utf-8").splitlines()]
        except (OSError, ValueError) as error:
            raise OutputError(f"{self.log}: damaged ({error}); run again into another --output") from None

    def truncate_log(self, frames: int, position: int) -> None:
        """Drops what an interrupted run logged after its last checkpoint.

        Args:
            frames: number of frames processed before the checkpoint.
            position: in the dataset, of the first frame after the checkpoint.

        Raises:
            OutputError: it has fewer lines than frames were processed.
        """
        lines = _complete_lines(self.log)
        if len(lines) < frames:
            raise OutputError(
                f"{self.log}: must have a line for each of the {frames} frames of the checkpoint, got {len(lines)}; "
                "run again into another --output"
            )
        atomic_write(self.log, "".join(lines[:frames]))
        if self.skipped.exists():
            kept = [line for line in _complete_lines(self.skipped) if json.loads(line)["position"] < position]
            atomic_write(self.skipped, "".join(kept))

    def record_skipped(self, position: int, error: DatasetError) -> None:
        """Logs a frame that could not be read."""
        with writing(self.skipped), self.skipped.open("a", encoding="utf-8") as file:
            file.write(json.dumps({"position": position, "error": str(error)}) + "\n")

    def read_skipped(self) -> list[dict[str, Any]]:
        """Position and error of the frames that could not be read, in order."""
        return [json.loads(line) for line in _complete_lines(self.skipped)]

    def write_previews(
        self, camera: Camera, frames: Iterable[tuple[int, RgbdFrame]], ground_truth: Trajectory | None
    ) -> None:
        """Writes what the report shows of the input: camera, ground truth and some frames.

        Args:
            camera: of the frames.
            frames: row in the trajectory and frame, for each image that is wanted.
            ground_truth: poses where they are known; None if none is.
        """
        with writing(self.previews):
            self.previews.mkdir(exist_ok=True)
        atomic_write(self.preview_camera, json.dumps(vars(camera)) + "\n")
        if ground_truth is not None:
            ground_truth.save_tum(self.preview_ground_truth)
        left, count = iter(frames), min(usable_cores(), _PREVIEW_THREADS)
        with ThreadPoolExecutor(count) as threads:
            while several := list(itertools.islice(left, count)):  # frames are read as they are taken
                list(threads.map(lambda preview: self._write_preview(*preview), several))

    def _write_preview(self, row: int, frame: RgbdFrame) -> None:
        millimeters = np.nan_to_num(np.rint(1000 * frame.depth), nan=0.0)
        depth = np.clip(millimeters, 0, np.iinfo(np.uint16).max).astype(np.uint16)
        _write_png(self.color_preview(row), cv2.cvtColor(frame.color, cv2.COLOR_RGB2BGR))
        _write_png(self.depth_preview(row), depth)

    def write_report(self) -> None:
        """Writes the report from the other files."""
        from spslam.evaluation.html_report import write_report  # needed after the last frame only

        write_report(self.path)


def _complete_lines(path: Path) -> list[str]:
    """Lines with their ends, without a last one that a killed run wrote in part; none where there is no file."""
    if not path.exists():
        return []
    return [line for line in path.read_text(encoding="utf-8").splitlines(keepends=True) if line.endswith("\n")]


def _write_png(path: Path, image: np.ndarray) -> None:
    atomic_write(path, cv2.imencode(".png", image)[1].tobytes())
