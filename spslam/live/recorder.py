"""Records a live camera in the `folder` layout on a thread, which never holds up the camera or the loop."""

from __future__ import annotations

import contextlib
import json
import math
import os
import queue
import threading
from pathlib import Path
from types import TracebackType
from typing import TextIO

import cv2
import numpy as np

from spslam.camera import Camera
from spslam.datasets.base import RgbdFrame
from spslam.errors import OutputError
from spslam.io import atomic_write, writing

WAITING_FRAMES = 32  # one second at 30 Hz; 68 MB of 640x480
# Full resolution of the colors: averaged over 2 x 2 pixels, as JPEG has it otherwise, patterns lose theirs.
_JPEG = [cv2.IMWRITE_JPEG_QUALITY, 95, cv2.IMWRITE_JPEG_SAMPLING_FACTOR, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444]
_PNG_LEVEL = 1  # four times as fast as the default, for a tenth more bytes
_MOST_UNITS = 65535
_PERIOD_S = 1 / 30  # of a camera, until its stamps tell
_LONGEST_PERIOD_S = 1.0


class FolderRecorder(contextlib.AbstractContextManager):
    """Writes frames to `color/NNNNNN.jpg` and `depth/NNNNNN.png`, with `intrinsics.json` and `times.txt`.

    If any frame has a pose, `poses.txt` has a row for each, of NaN where it is unknown.

    `spslam run folder --data DIR` reads the result, also after a kill: each image appears whole, and a frame's time is
    the last that is written of it. Times ascend, as they must to be run: where a camera's stamps go back, those after
    go on from there, and a stamp that comes again is half a frame's period later. Color is JPEG of quality 95. A frame
    that comes while `WAITING_FRAMES` others wait for the disk is left out and counted.

    Args:
        folder: made where it is missing; it must be empty.
        camera: of all frames.
        depth_scale: depth is rounded to 1 / `depth_scale` m; what does not fit 16 bits then is stored as 0, unknown.

    Attributes:
        frames: recorded so far.
        left_out: frames that were not recorded.
        failure: why recording stopped before its end; None where it did not.

    Raises:
        OutputError: the folder holds something, or can't be written.
    """

    def __init__(self, folder: str | os.PathLike, camera: Camera, depth_scale: float = 1000.0) -> None:
        self.folder, self._scale = Path(folder), depth_scale
        if self.folder.is_dir() and any(self.folder.iterdir()):
            raise OutputError(f"{self.folder}: is not empty; record into another folder")
        with writing(self.folder):
            for name in ("color", "depth"):
                (self.folder / name).mkdir(parents=True, exist_ok=True)
        intrinsics = {name: getattr(camera, name) for name in ("width", "height", "fx", "fy", "cx", "cy")}
        content = json.dumps(intrinsics | {"depth_scale": depth_scale}, indent=1) + "\n"
        atomic_write(self.folder / "intrinsics.json", content)
        self.frames = self.left_out = 0
        self.failure: OutputError | None = None
        self._waiting: queue.Queue[RgbdFrame | None] = queue.Queue()
        self._clock = _AscendingTimes()
        self._times: TextIO | None = None
        self._poses: TextIO | None = None
        self._thread = threading.Thread(target=self._run, name="spslam-recorder", daemon=True)
        self._thread.start()

    def offer(self, frame: RgbdFrame) -> None:
        """Takes a frame to be recorded, or leaves it out; never waits. The frame must not be changed after."""
        if self.failure is not None or self._waiting.qsize() >= WAITING_FRAMES:
            self.left_out += 1
        else:
            self._waiting.put(frame)

    def close(self) -> None:
        """Writes the frames that wait; a folder without any is removed again. May be called again."""
        self._waiting.put(None)
        self._thread.join()
        if not self.frames:
            self._remove()

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self.close()

    def __repr__(self) -> str:
        return f"FolderRecorder({str(self.folder)!r}, {self.frames} frames, {self.left_out} left out)"

    def _run(self) -> None:
        with contextlib.ExitStack() as files:
            while (frame := self._waiting.get()) is not None:
                if self.failure is not None:
                    self.left_out += 1
                    continue
                try:
                    self._write(frame, files)
                    self.frames += 1
                except OutputError as error:
                    self.failure = error
                    self.left_out += 1
                except Exception as error:  # whatever it is: a thread that ends silently would look like a slow disk
                    self.failure = OutputError(f"{self.folder}: frame {self.frames} can't be written: {error}")
                    self.left_out += 1

    def _remove(self) -> None:
        """Removes a recording without a frame: nobody could run it, and the next one would be refused there."""
        with contextlib.suppress(OSError):
            for name in ("color", "depth"):
                (self.folder / name).rmdir()
            (self.folder / "intrinsics.json").unlink()
            self.folder.rmdir()

    def _write(self, frame: RgbdFrame, files: contextlib.ExitStack) -> None:
        name = f"{self.frames:06d}"
        color = cv2.cvtColor(frame.color, cv2.COLOR_RGB2BGR)
        units = np.rint(frame.depth * np.float32(self._scale))
        depth = np.where((units > 0) & (units <= _MOST_UNITS), units, 0).astype(np.uint16)
        self._write_image("depth", f"{name}.png", depth, [cv2.IMWRITE_PNG_COMPRESSION, _PNG_LEVEL])
        self._write_image("color", f"{name}.jpg", color, _JPEG)
        if self._times is None:
            self._times = self._open("times.txt", files)
        if self._poses is None and frame.pose is not None:
            if self.frames:
                # Their rows appear at once: some of them alone would be the poses of another number of frames.
                atomic_write(self.folder / "poses.txt", self.frames * (_pose_row(None) + "\n"))
            self._poses = self._open("poses.txt", files)
        if self._poses is not None:
            self._append(self._poses, _pose_row(frame.pose))
        self._append(self._times, f"{self._clock.next(frame.timestamp):.9f}")

    def _write_image(self, kind: str, name: str, image: np.ndarray, options: list[int]) -> None:
        """Writes an image under a hidden name and renames it, so that it is there whole or not at all."""
        path = self.folder / kind / name
        hidden = path.with_name(f".{name}")
        content = cv2.imencode(path.suffix, image, options)[1]
        try:
            with writing(path):
                hidden.write_bytes(content.tobytes())
                os.replace(hidden, path)
        except OutputError:
            with contextlib.suppress(OSError):
                hidden.unlink(missing_ok=True)
            raise

    def _open(self, name: str, files: contextlib.ExitStack) -> TextIO:
        path = self.folder / name
        with writing(path):
            file = path.open("a", encoding="utf-8", buffering=1)
        files.callback(_close, file)
        return file

    def _append(self, file: TextIO, row: str) -> None:
        with writing(file.name):
            file.write(row + "\n")


class _AscendingTimes:
    """The times of a recording by a camera's stamps, whose clock may be set back, or stand still."""

    def __init__(self) -> None:
        self._stamp: float | None = None
        self._time, self._shift_s, self._period_s = -math.inf, 0.0, _PERIOD_S

    def next(self, stamp: float) -> float:
        """The time of the next frame, s."""
        step_s = 0.0 if self._stamp is None else stamp - self._stamp
        if step_s < 0:
            self._shift_s += self._period_s - step_s
        elif 0 < step_s <= _LONGEST_PERIOD_S:
            self._period_s = step_s
        self._stamp = stamp
        self._time = max(stamp + self._shift_s, self._time + self._period_s / 2)
        return self._time


def _pose_row(pose: np.ndarray | None) -> str:
    """A row of `poses.txt`, of NaN where the pose is unknown."""
    return " ".join(f"{value:.12g}" for value in (np.full(16, np.nan) if pose is None else pose.reshape(-1)))


def _close(file: TextIO) -> None:
    """Closes a file; a row that could not be written was reported already."""
    with contextlib.suppress(OSError):
        file.close()
