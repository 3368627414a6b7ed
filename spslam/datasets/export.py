"""Writes a sequence as a folder recording (docs/own-data.md), with ground truth, for other programs or to keep."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np

from spslam.datasets.base import RgbdDataset, RgbdFrame
from spslam.datasets.prefetch import prefetch
from spslam.errors import DatasetError, OutputError
from spslam.io import atomic_write, writing

# Units per meter of 16-bit depth: steps of 0.2 mm up to 13.1 m, as in TUM's recordings.
DEPTH_SCALE = 5000
_MOST = 65535


def export_folder(dataset: RgbdDataset, folder: str | os.PathLike) -> None:
    """Writes all frames to `color/` and `depth/`, with intrinsics, poses, times and, where it is known, the surface.

    `spslam run folder --data FOLDER` reads it. Depth is rounded to 0.2 mm; beyond 13.1 m it is 0. Files: PNG images,
    `intrinsics.json`, `poses.txt` (16 numbers per frame, camera to world), `times.txt` (s), `gt_mesh.ply` of generated
    data.

    Args:
        dataset: the frames.
        folder: made where it is missing; files in it are replaced.

    Raises:
        DatasetError: a frame that can't be read.
        OutputError: the folder can't be written.
    """
    folder = Path(folder)
    for number in range(len(dataset)):
        _write_frame(dataset[number], folder)
    _write_texts(dataset, np.arange(len(dataset)), folder)


def import_folder(
    dataset: RgbdDataset, folder: str | os.PathLike, progress: Callable[[int], object] | None = None
) -> list[str]:
    """Writes a copy of a recording as `export_folder` does, without the frames that can't be read.

    Nothing is left where it fails or is interrupted: the copy is made beside the folder and renamed at the end.

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
    copy = folder.resolve().with_name(f".{folder.resolve().name}.{os.getpid()}.tmp")
    try:
        kept, faults = [], []
        with writing(folder):
            copy.mkdir(parents=True)
        with prefetch(dataset) as frames:
            for number, frame in enumerate(frames):
                if isinstance(frame, DatasetError):
                    faults.append(str(frame))
                else:
                    _write_frame(frame, copy)
                    kept.append(number)
                if progress is not None:
                    progress(number + 1)
        if not kept:
            raise DatasetError(f"{dataset.name}: no frame can be read; the first: {faults[0]}")
        _write_texts(dataset, np.array(kept), copy)
        with writing(folder):
            os.replace(copy, folder)  # an empty folder is replaced, too
    finally:
        shutil.rmtree(copy, ignore_errors=True)
    return faults


def _write_texts(dataset: RgbdDataset, kept: np.ndarray, folder: Path) -> None:
    camera = dataset.camera
    intrinsics = {name: getattr(camera, name) for name in ("width", "height", "fx", "fy", "cx", "cy")}
    atomic_write(folder / "intrinsics.json", json.dumps(intrinsics | {"depth_scale": DEPTH_SCALE}, indent=1))
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


def _write_frame(frame: RgbdFrame, folder: Path) -> None:
    units = np.round(frame.depth * DEPTH_SCALE)
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
