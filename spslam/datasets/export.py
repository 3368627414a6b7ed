"""Writes a sequence as a folder recording (docs/own-data.md), with ground truth, for other programs or to keep."""

from __future__ import annotations

import contextlib
import fcntl
import json
import os
import shutil
import signal
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from types import FrameType

import cv2
import numpy as np

from spslam.datasets.base import RgbdDataset, RgbdFrame
from spslam.datasets.prefetch import prefetch
from spslam.errors import DatasetError, OutputError
from spslam.io import atomic_write, writing

# Units per meter of 16-bit depth, the first that reach the farthest depth of a dataset are taken: steps of 0.2 mm up to
# 13.1 m, as in TUM's recordings, of 1 mm up to 65 m, and so on up to 1310 m, beyond what dataset.max_depth_m allows.
DEPTH_SCALES = (5000, 1000, 500, 200, 100, 50)
_MOST = 65535


def export_folder(dataset: RgbdDataset, folder: str | os.PathLike) -> None:
    """Writes all frames to `color/` and `depth/`, with intrinsics, poses, times and, where it is known, the surface.

    `spslam run folder --data FOLDER` reads it. Depth is rounded to 0.2 mm. Where the dataset's `depth_range` ends
    beyond 13.1 m it is rounded to the step by which it still fits into 16 bits (1 mm up to 65 m); of a range without an
    end, depth beyond 13.1 m is 0. Files: PNG images, `intrinsics.json` with the depth's units per meter, `poses.txt`
    (16 numbers per frame, camera to world), `times.txt` (s), `gt_mesh.ply` of generated data.

    Args:
        dataset: the frames.
        folder: made where it is missing; files in it are replaced.

    Raises:
        DatasetError: a frame that can't be read.
        OutputError: the folder can't be written.
    """
    folder = Path(folder)
    scale = _depth_scale(dataset)
    for number in range(len(dataset)):
        _write_frame(dataset[number], folder, scale)
    _write_texts(dataset, np.arange(len(dataset)), folder)


def import_folder(
    dataset: RgbdDataset, folder: str | os.PathLike, progress: Callable[[int], object] | None = None
) -> list[str]:
    """Writes a copy of a recording as `export_folder` does, without the frames that can't be read.

    Nothing is left where it fails, is interrupted or is asked to end (SIGTERM): the copy is made beside the folder and
    renamed at the end. What a killed process has left of a copy to the same folder is removed.

    Args:
        dataset: the frames.
        folder: must not exist, or be empty.
        progress: called with the number of frames done after each.

    Returns:
        Why frames were left out, one line each.

    Raises:
        DatasetError: no frame can be read.
        OutputError: the folder exists and isn't empty, or can't be written.
    """
    folder = Path(folder)
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise OutputError(f"{folder}: must be a new or an empty folder, got one with files")
    scale = _depth_scale(dataset)
    with _ended_by_sigterm(), _new_copy(folder) as copy:
        kept, faults = [], []
        with prefetch(dataset) as frames:
            for number, frame in enumerate(frames):
                if isinstance(frame, DatasetError):
                    faults.append(str(frame))
                else:
                    _write_frame(frame, copy, scale)
                    kept.append(number)
                if progress is not None:
                    progress(number + 1)
        if not kept:
            raise DatasetError(f"{dataset.name}: no frame can be read; the first: {faults[0]}")
        _write_texts(dataset, np.array(kept), copy)
        with writing(folder):
            os.replace(copy, folder)  # an empty folder is replaced, too
    return faults


@contextlib.contextmanager
def _new_copy(folder: Path) -> Iterator[Path]:
    """A hidden folder beside a folder, which is removed at the end, locked until then."""
    folder = folder.resolve()
    copy = folder.with_name(f".{folder.name}.{os.getpid()}.tmp")
    with contextlib.ExitStack() as ends:
        with writing(folder):
            for left in folder.parent.iterdir() if folder.parent.is_dir() else ():
                if left.name.startswith(f".{folder.name}.") and _is_of_dead(left, folder.name):
                    shutil.rmtree(left, ignore_errors=True)
            ends.callback(shutil.rmtree, copy, ignore_errors=True)
            copy.mkdir(parents=True)
            descriptor = os.open(copy, os.O_RDONLY)
            ends.callback(os.close, descriptor)
            with contextlib.suppress(OSError):  # a file system without locks
                fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        yield copy


def _is_of_dead(path: Path, name: str) -> bool:
    """Whether a path is a copy to `name` whose process has ended, as none holds a lock on it."""
    number = path.name.removeprefix(f".{name}.").removesuffix(".tmp")
    if path.name != f".{name}.{number}.tmp" or not number.isdecimal() or path.is_symlink() or not path.is_dir():
        return False
    with contextlib.suppress(OSError):  # another user's, locked, or on a file system without locks
        descriptor = os.open(path, os.O_RDONLY)
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            return True
        finally:
            os.close(descriptor)
    return False


class _Ended(BaseException):
    """SIGTERM has come."""


@contextlib.contextmanager
def _ended_by_sigterm() -> Iterator[None]:
    """Where nothing else handles SIGTERM, lets it end this process only once what was begun is removed."""
    is_main = threading.current_thread() is threading.main_thread()  # no other thread may set a handler
    if not is_main or signal.getsignal(signal.SIGTERM) is not signal.SIG_DFL:
        yield
        return

    def end(number: int, frame: FrameType | None) -> None:
        raise _Ended

    signal.signal(signal.SIGTERM, end)
    try:
        yield
    except _Ended:
        signal.signal(signal.SIGTERM, signal.SIG_DFL)
        os.kill(os.getpid(), signal.SIGTERM)
    finally:
        signal.signal(signal.SIGTERM, signal.SIG_DFL)


def _depth_scale(dataset: RgbdDataset) -> int:
    """Units per meter by which depth up to the dataset's farthest fits into 16 bits."""
    farthest_m = dataset.depth_range[1]
    if not np.isfinite(farthest_m):
        return DEPTH_SCALES[0]
    return next((scale for scale in DEPTH_SCALES if farthest_m * scale <= _MOST), DEPTH_SCALES[-1])


def _write_texts(dataset: RgbdDataset, kept: np.ndarray, folder: Path) -> None:
    camera = dataset.camera
    intrinsics = {name: getattr(camera, name) for name in ("width", "height", "fx", "fy", "cx", "cy")}
    atomic_write(folder / "intrinsics.json", json.dumps(intrinsics | {"depth_scale": _depth_scale(dataset)}, indent=1))
    atomic_write(folder / "times.txt", "".join(f"{time:.9f}\n" for time in dataset.timestamps()[kept]))
    poses = dataset.poses()
    if poses is not None:
        rows = (" ".join(f"{value:.12g}" for value in pose.reshape(-1)) for pose in poses[kept])
        atomic_write(folder / "poses.txt", "".join(f"{row}\n" for row in rows))
    if dataset.surface is not None:
        import trimesh

        vertices, faces = dataset.surface.triangles()
        mesh = trimesh.Trimesh(vertices, faces, process=False)
        atomic_write(folder / "gt_mesh.ply", lambda path: mesh.export(path))


def _write_frame(frame: RgbdFrame, folder: Path, depth_scale: int) -> None:
    units = np.round(frame.depth * depth_scale)
    depth = np.where(units <= _MOST, units, 0).astype(np.uint16)
    color = cv2.cvtColor(frame.color, cv2.COLOR_RGB2BGR)
    for name, image in (("color", color), ("depth", depth)):
        written, content = cv2.imencode(".png", image)
        if not written:
            raise DatasetError(f"{folder}: frame {frame.index} could not be encoded as PNG")
        path = folder / name / f"{frame.index:06d}.png"
        with writing(path):
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(content.tobytes())
