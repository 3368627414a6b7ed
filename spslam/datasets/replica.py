"""Replica as rendered for iMAP and NICE-SLAM.

`results/frameNNNNNN.jpg` and `results/depthNNNNNN.png` (16-bit), `traj.txt` with 16 numbers per line (4x4 camera
to world, OpenCV axes) and `cam_params.json` beside the scene or in its parent folder: `{"camera": {"w", "h", "fx",
"fy", "cx", "cy", "scale"}}`, `scale` being the depth value of one meter.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from spslam.camera import Camera
from spslam.datasets.files import FileDataset, find_numbered, pair_numbered, require_folder
from spslam.datasets.images import DEPTH_SCALE_RULE, first_size, is_depth_scale
from spslam.datasets.reference_poses import table_poses
from spslam.datasets.text import camera_from_matrix, read_json
from spslam.errors import DatasetError, brief

CAMERA_FILE = "cam_params.json"
FRAMES_PER_SECOND = 30.0


def open_replica(folder: Path) -> FileDataset:
    """Opens a scene of the NICE-SLAM Replica layout.

    Args:
        folder: the scene; `traj.txt` may be missing or shorter than the sequence.

    Raises:
        DatasetError: a missing folder, another layout, missing or inconsistent camera parameters, unreadable poses.
    """
    results = require_folder(folder) / "results"
    colors = find_numbered(results, r"frame(\d+)\.(?:jpg|jpeg|png)")
    depths = find_numbered(results, r"depth(\d+)\.png")
    if not colors:
        raise DatasetError(f"{folder}: must contain results/frame000000.jpg and so on, got none")
    camera, units_per_meter = _read_camera(_find_camera_file(folder), *first_size(colors.values()))
    frames = pair_numbered(colors, depths, FRAMES_PER_SECOND)
    reference = table_poses(list(frames), folder / "traj.txt")
    name, doubts = f"replica/{folder.name}", reference.doubts
    return FileDataset(name, camera, list(frames.values()), reference.poses, units_per_meter, doubts=doubts)


def _find_camera_file(folder: Path) -> Path:
    for candidate in (folder / CAMERA_FILE, folder.parent / CAMERA_FILE):
        if candidate.is_file():
            return candidate
    raise DatasetError(f"{folder / CAMERA_FILE}: no such file, nor in the folder above")


def _read_camera(path: Path, width: int, height: int) -> tuple[Camera, float]:
    values = read_json(path).get("camera")
    names = ("w", "h", "fx", "fy", "cx", "cy", "scale")
    if not isinstance(values, dict) or not all(isinstance(values.get(name), (int, float)) for name in names):
        raise DatasetError(f"{path}: must contain numbers camera.{{{', '.join(names)}}}, got {brief(values)}")
    if (values["w"], values["h"]) != (width, height):
        raise DatasetError(
            f"{path}: must give the images' size {width}x{height}, got {brief(values['w'])}x{brief(values['h'])}"
        )
    if not is_depth_scale(values["scale"]):
        raise DatasetError(f"{path}: camera.scale must be {DEPTH_SCALE_RULE}, got {brief(values['scale'])}")
    matrix = np.array([[values["fx"], 0, values["cx"]], [0, values["fy"], values["cy"]], [0, 0, 1]])
    return camera_from_matrix(matrix, width, height, str(path)), float(values["scale"])
