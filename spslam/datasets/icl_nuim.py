"""ICL-NUIM (Handa et al. 2014): rendered rooms with exact depth, in the form for TUM's tools.

`associations.txt` lists `number depth/N.png number rgb/N.png`; depth has 5000 units per meter; `*.gt.freiburg` has the
poses by number, `number tx ty tz qx qy qz qw`. The camera is (481.2, 480, 319.5, 239.5). Its authors give fy = -480:
the world that POV-Ray renders is left-handed. The images are upright, so poses are mirrored to match: with S = diag(1,
-1, 1), R' = S R S and t' = S t.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from spslam.camera import Camera
from spslam.datasets.base import MAX_FRAMES
from spslam.datasets.files import FileDataset, FramePaths, require_folder
from spslam.datasets.images import first_size
from spslam.datasets.reference_poses import ReferencePoses
from spslam.datasets.text import read_rows
from spslam.datasets.tum import UNITS_PER_METER
from spslam.errors import DatasetError, brief
from spslam.trajectory import Trajectory

ASSOCIATIONS_FILE = "associations.txt"
_CAMERA = Camera(640, 480, 481.2, 480.0, 319.5, 239.5)
_FRAMES_PER_SECOND = 30.0
_MIRROR = np.diag([1.0, -1.0, 1.0, 1.0])


def open_icl_nuim(folder: Path) -> FileDataset:
    """Opens a sequence ("TUM RGB-D compatible PNGs").

    Args:
        folder: the sequence; the poses may lie in it or be missing.

    Raises:
        DatasetError: a missing folder or list, or a malformed line.
    """
    frames = _frames(require_folder(folder))
    camera = _CAMERA.resized(*first_size(frame.color for frame in frames.values()))
    reference = _poses(folder, list(frames))
    return FileDataset(
        f"icl_nuim/{folder.name}",
        camera,
        list(frames.values()),
        reference.poses,
        UNITS_PER_METER,
        doubts=reference.doubts,
    )


def _frames(folder: Path) -> dict[int, FramePaths]:
    path = folder / ASSOCIATIONS_FILE
    frames: dict[int, FramePaths] = {}
    for words in read_rows(path, columns=4):
        if not words[0].isdecimal() or len(words[0]) > 9:
            raise DatasetError(
                f"{path}: must list `number depth number color`, as ICL-NUIM does, got {brief(' '.join(words))!r}; "
                "images with time stamps belong into the lists rgb.txt and depth.txt, as in TUM's sequences"
            )
        number = int(words[0])
        frames.setdefault(number, FramePaths(folder / words[3], folder / words[1], number / _FRAMES_PER_SECOND))
        if len(frames) > MAX_FRAMES:
            raise DatasetError(f"{path}: must list at most {MAX_FRAMES} images")
    if not frames:
        raise DatasetError(f"{path}: must list at least one image, got none")
    return dict(sorted(frames.items()))


def _poses(folder: Path, numbers: list[int]) -> ReferencePoses:
    files = sorted(folder.glob("*.gt.freiburg"))
    if not files:
        return ReferencePoses()
    trajectory = Trajectory.load_tum(files[0], skip_unknown=True)
    rows = {int(round(time)): row for row, time in enumerate(trajectory.timestamps) if abs(time) < MAX_FRAMES}
    poses = np.full((len(numbers), 4, 4), np.nan)
    for place, number in enumerate(numbers):
        if number in rows:
            poses[place] = _MIRROR @ trajectory.poses[rows[number]] @ _MIRROR
    return ReferencePoses.of(poses, [], str(files[0]))
