"""7-Scenes (Shotton et al. 2013): Kinect v1 in seven small rooms.

A scene folder holds `seq-01`, `seq-02`, ..., each with `frame-NNNNNN.color.png` (or jpg), `.depth.png`
(16-bit millimeters; 0 and 65535 are invalid) and `.pose.txt` (4x4 camera to world, OpenCV axes). The poses are
KinectFusion's, of the depth camera; their rotations aren't quite orthonormal and are projected to SO(3). The dataset's
authors did not register color and depth to each other, nor do they say where the color camera is. Here color is brought
to the depth camera's view by a calibration of a Kinect v1 that is published elsewhere (below); depth stays as measured.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from spslam.camera import Camera
from spslam.datasets.files import FileDataset, find_numbered, pair_numbered, require_folder
from spslam.datasets.findings import Finding
from spslam.datasets.images import first_size
from spslam.datasets.reference_poses import file_poses
from spslam.datasets.registration import ColorToDepth
from spslam.datasets.text import read_intrinsics_matrix, read_rows
from spslam.errors import DatasetError

SPLITS = ("train", "test")
INTRINSICS_FILE = "camera-intrinsics.txt"
FRAMES_PER_SECOND = 30.0
# "The default intrinsics for this sensor", as the dataset's page gives them for 640x480.
_DEFAULT_CAMERA = Camera(640, 480, 585.0, 585.0, 320.0, 240.0)
# The color camera, and where it is: points of the depth camera to points of the color camera, m. Used for 7-Scenes by
# ACE (Brachmann et al. 2023), datasets/setup_7scenes.py, which takes the place from the LIRIS human activities dataset
# (Wolf et al. 2014, "Kinect calibration"), whose Kinect was another of this kind.
_COLOR_CAMERA = Camera(640, 480, 525.0, 525.0, 320.0, 240.0)
_COLOR_FROM_DEPTH = np.array(
    [
        [9.9996518012567637e-01, 2.6765126468950343e-03, -7.9041012313000904e-03, -2.5558943178152542e-02],
        [-2.7409311281316700e-03, 9.9996302803027592e-01, -8.1504520778013286e-03, 1.0109636268061706e-04],
        [7.8819942130445332e-03, 8.1718328771890631e-03, 9.9993554558014031e-01, 2.0318321729487039e-03],
        [0, 0, 0, 1],
    ]
)
_GUESSED_CAMERA = Finding(
    "default camera",
    f"the camera is not known: there is no {INTRINSICS_FILE}, so that of 7-Scenes is taken, whose images are 640x480",
    f"write {INTRINSICS_FILE} with fx fy cx cy (px)",
)
_MOST_DIGITS = 9  # of a sequence's number
_COLOR_NAME = r"frame-(\d+)\.color\.(?:png|jpg|jpeg)"
_DEPTH_NAME = r"frame-(\d+)\.depth\.png"
_POSE_NAME = r"frame-(\d+)\.pose\.txt"


def open_seven_scenes(folder: Path, sequence: str | int | None = None, registered: bool | None = None) -> FileDataset:
    """Opens one sequence of a scene.

    The camera is that of `camera-intrinsics.txt` in the sequence or the scene, else the dataset's default
    (585, 585, 320, 240), scaled to the image size. A frame without pose file, or with a non-finite or malformed pose,
    has no pose; the last is a doubt, and so is the default camera for images that are not 640x480. A frame with an
    image missing is one that raises when it is read.

    Args:
        folder: the scene (with `seq-XX` in it) or a sequence itself.
        sequence: `seq-03` or its number; `train` or `test` is the first of TrainSplit.txt or TestSplit.txt. None is the
            first that is there.
        registered: whether the images are one camera's already and are left as they are. None: they are not if the
            camera is the dataset's default one, and are of any other.

    Raises:
        DatasetError: a missing folder, another layout, an absent sequence, unreadable intrinsics.
    """
    sequence_folder = _choose_sequence(require_folder(folder), sequence)
    colors = find_numbered(sequence_folder, _COLOR_NAME)
    depths = find_numbered(sequence_folder, _DEPTH_NAME)
    if not colors and not depths:
        raise DatasetError(
            f"{sequence_folder}: must contain 7-Scenes frames (frame-000000.color.png, .depth.png), got none; "
            + _hint(sequence_folder)
        )
    camera, doubts = _find_camera(sequence_folder, list(colors.values()))
    frames = pair_numbered(colors, depths, FRAMES_PER_SECOND)
    reference = file_poses(list(frames), find_numbered(sequence_folder, _POSE_NAME))
    registration = None if _is_registered(camera, registered) else _registration(camera)
    return FileDataset(
        f"7scenes/{sequence_folder.parent.name}/{sequence_folder.name}",
        camera,
        list(frames.values()),
        reference.poses,
        units_per_meter=1000.0,
        invalid_depth=(65535,),
        registration=registration,
        is_registered=registration is not None,  # what is taken as one camera's need not be
        doubts=(*doubts, *reference.doubts),
    )


def list_sequences(scene: Path, split: str | None = None) -> list[str]:
    """Names of a scene's sequence folders, ascending; of those in TrainSplit.txt or TestSplit.txt if asked.

    Args:
        scene: the scene's folder.
        split: `train`, `test` or None for all that are there.

    Raises:
        ValueError: another split.
        DatasetError: a missing folder, or a missing or malformed split file.
    """
    if split is None:
        return sorted(path.name for path in require_folder(scene).glob("seq-*") if path.is_dir())
    if split not in SPLITS:
        raise ValueError(f"list_sequences: split must be 'train' or 'test', got {split!r}")
    rows = read_rows(scene / f"{split.capitalize()}Split.txt", columns=1)
    return sorted(_sequence_name("".join(row)) for row in rows)


def _hint(folder: Path) -> str:
    packed = sorted(path.name for path in folder.glob("seq-*.zip"))
    return f"unpack {packed[0]} and its like first" if packed else "a scene holds them in seq-01, seq-02, ..."


def _choose_sequence(folder: Path, sequence: str | int | None) -> Path:
    names = list_sequences(folder)
    if not names:
        if sequence is not None and folder.name != _sequence_name(sequence):
            raise DatasetError(f"{folder}: must contain {_sequence_name(sequence)}, got no seq-XX folder")
        return folder
    if sequence is None:
        return folder / names[0]
    if sequence in SPLITS:
        sequence = next(iter(list_sequences(folder, str(sequence))), str(sequence))
    name = _sequence_name(sequence)
    if name not in names:
        raise DatasetError(f"{folder}: sequence must be one of {', '.join(names)}, got {sequence}")
    return folder / name


def _sequence_name(sequence: str | int) -> str:
    digits = re.search(r"\d+$", str(sequence))
    has_number = digits is not None and len(digits.group()) <= _MOST_DIGITS
    return f"seq-{int(digits.group()):02d}" if digits and has_number else str(sequence)


def _find_camera(sequence_folder: Path, colors: list[Path]) -> tuple[Camera, tuple[Finding, ...]]:
    """The camera of a sequence, and the doubt that it is a guess: the dataset's, for images of another size."""
    width, height = first_size(colors)
    for folder in (sequence_folder, sequence_folder.parent):
        if (folder / INTRINSICS_FILE).is_file():
            return read_intrinsics_matrix(folder / INTRINSICS_FILE, width, height), ()
    is_its_own = (width, height) == (_DEFAULT_CAMERA.width, _DEFAULT_CAMERA.height)
    return _DEFAULT_CAMERA.resized(width, height), () if is_its_own else (_GUESSED_CAMERA,)


def _is_registered(camera: Camera, registered: bool | None) -> bool:
    if registered is not None:
        return registered
    return camera != _DEFAULT_CAMERA.resized(camera.width, camera.height)


def _registration(camera: Camera) -> ColorToDepth:
    color = _COLOR_CAMERA.resized(camera.width, camera.height)
    return ColorToDepth(color, camera, _COLOR_FROM_DEPTH)
