"""The layout of Neural RGB-D (Azinovic et al. 2022), which "Synthetic RGB-D" is distributed in.

`images/imgN.png` (or jpg), `depth_filtered/depthN.png` (noisy and filtered), `depth_with_noise/depthN.png`
(before the filter) and `depth/depthN.png` (exact), each in 16-bit millimeters, `poses.txt` with four lines per frame
(4x4 camera to world, OpenGL camera axes: x right, y up, z backward) and `focal.txt` with one number. The principal
point is the image's middle.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from spslam.camera import Camera
from spslam.datasets.files import FileDataset, find_numbered, pair_numbered, require_folder
from spslam.datasets.images import first_size
from spslam.datasets.reference_poses import table_poses
from spslam.datasets.text import camera_from_matrix, read_numbers
from spslam.errors import DatasetError

FRAMES_PER_SECOND = 30.0
DEPTH_FOLDERS = {"filtered": "depth_filtered", "noisy": "depth_with_noise", "exact": "depth"}
_OPENCV_FROM_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])


def open_synthetic_rgbd(folder: Path, depth_variant: str | None = None) -> FileDataset:
    """Opens a scene of the Neural RGB-D layout.

    A pose with NaN, or none for a frame, leaves that frame without one; `poses.txt` may be missing altogether.

    Args:
        folder: the scene.
        depth_variant: `filtered`, `noisy` or `exact`. None is the first of these that is there.

    Raises:
        DatasetError: a missing folder, another layout, the variant's folder missing, unreadable focal length or poses.
    """
    colors = find_numbered(require_folder(folder) / "images", r"img(\d+)\.(?:png|jpg|jpeg)")
    depths = find_numbered(_depth_folder(folder, depth_variant), r"depth(\d+)\.png")
    if not colors:
        raise DatasetError(f"{folder}: must contain images/img0.png (or jpg) and so on, got none")
    camera = _read_camera(folder / "focal.txt", *first_size(colors.values()))
    frames = pair_numbered(colors, depths, FRAMES_PER_SECOND)
    reference = table_poses(list(frames), folder / "poses.txt")
    poses = None if reference.poses is None else reference.poses @ _OPENCV_FROM_OPENGL
    name, doubts = f"synthetic_rgbd/{folder.name}", reference.doubts
    return FileDataset(name, camera, list(frames.values()), poses, units_per_meter=1000.0, doubts=doubts)


def _depth_folder(folder: Path, variant: str | None) -> Path:
    present = [name for name, subfolder in DEPTH_FOLDERS.items() if (folder / subfolder).is_dir()]
    if variant is not None and variant not in DEPTH_FOLDERS:
        raise DatasetError(f"depth_variant must be one of {', '.join(DEPTH_FOLDERS)}, got {variant}")
    if not present:
        raise DatasetError(f"{folder}: must contain a folder depth_filtered or depth, got neither")
    if variant is not None and variant not in present:
        raise DatasetError(
            f"{folder / DEPTH_FOLDERS[variant]}: no such folder; "
            f"there is {DEPTH_FOLDERS[present[0]]} (depth_variant: {present[0]})"
        )
    return folder / DEPTH_FOLDERS[variant or present[0]]


def _read_camera(path: Path, width: int, height: int) -> Camera:
    numbers = read_numbers(path)
    if numbers.size != 1:
        raise DatasetError(f"{path}: must contain one number, the focal length in pixels, got {numbers.size}")
    focal = numbers[0]
    matrix = np.array([[focal, 0, (width - 1) / 2], [0, focal, (height - 1) / 2], [0, 0, 1]])
    return camera_from_matrix(matrix, width, height, str(path))
