"""Finding out what a path is: which of the formats, by its files and by what is in them."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from spslam.datasets.arkitscenes import COLOR_FOLDERS as ARKITSCENES_FOLDERS
from spslam.datasets.arkitscenes import DEPTH_FOLDER as ARKITSCENES_DEPTH
from spslam.datasets.calibration_files import INTRINSICS_FILES
from spslam.datasets.folder import COLOR_FOLDERS, POSES_FILE, TIMES_FILE
from spslam.datasets.icl_nuim import ASSOCIATIONS_FILE
from spslam.datasets.open3d_recording import find_folder, trajectory_file
from spslam.datasets.record3d import METADATA_FILES
from spslam.datasets.rosbag.bag import BAG_SUFFIXES, METADATA_FILE, Bag
from spslam.datasets.rosbag.realsense import is_realsense
from spslam.datasets.scannetpp import POSES_FILE as SCANNETPP_FILE
from spslam.datasets.stray_scanner import ODOMETRY_FILE
from spslam.datasets.tum import names_of
from spslam.datasets.video import VIDEO_SUFFIXES
from spslam.datasets.video_recording import find_video
from spslam.errors import DatasetError

# Files that are recordings, or that somebody may take for one.
RECORDING_SUFFIXES = (*BAG_SUFFIXES, ".r3d", ".sens", *VIDEO_SUFFIXES)
# Of formats whose depth is 16-bit millimeters by default; only these names are looked for, at one level.
_OPEN3D_INTRINSICS = ("camera_intrinsic.json", "intrinsic.json")
# As a word: not in "bonnet" or "carbonn".
_BONN = re.compile(r"(?<![a-z])bonn(?![a-z])")


@dataclass(frozen=True)
class Identified:
    """What a path was taken for.

    Attributes:
        config: name of the shipped configuration.
        description: in words.
    """

    config: str
    description: str


def identify_recording(path: Path) -> Identified:
    """Which configuration reads a path.

    Args:
        path: a file or a folder.

    Raises:
        DatasetError: there is none, a bag that can't be read, or a path that is of no format known.
    """
    if not path.exists():
        raise DatasetError(f"{path}: no such configuration, file or folder")
    kinds = _FOLDERS if path.is_dir() else _FILES
    for config, description, fits in kinds:
        if fits(path):
            return Identified(config, description)
    if path.is_dir():
        raise DatasetError(f"{path}: is no recording that is known: {_lacking(path)}; {_inside(path)}")
    raise DatasetError(
        f"{path}: is no recording that is known: must be a ROS bag ({', '.join(BAG_SUFFIXES)}), .mkv of Azure Kinect, "
        ".r3d of Record3D or .sens of ScanNet; a video needs a folder with its depth images beside it"
    )


def _lacking(path: Path) -> str:
    """What a folder must have to be a recording: of the format that it comes near to, or else of any."""
    for present, absent in (("rgb.txt", "depth.txt"), ("depth.txt", "rgb.txt")):
        if (path / present).is_file():
            return f"beside {present} must be {absent}, a line `timestamp file` for each image, as in TUM's sequences"
    called = {item.name.lower(): item.name for item in path.iterdir() if item.is_dir()}
    color, depth = next((name for name in COLOR_FOLDERS if name in called), None), "depth"
    if color is None or depth not in called:
        return (
            "must contain color/ and depth/ with the intrinsics, a ROS bag, or the layout of a dataset in "
            "docs/datasets.md"
        )
    renamed = [f"{called[name]} to {name}" for name in (color, depth) if called[name] != name]
    if renamed:
        return f"folders of images must have names in lower case, rename {' and '.join(renamed)}"
    return (
        f"beside {color}/ and depth/ must be the intrinsics of the color images: intrinsics.txt with fx fy cx cy (px)"
    )


def _inside(path: Path) -> str:
    names = sorted(item.name + "/" * item.is_dir() for item in path.iterdir())
    listed = ", ".join(names[:8]) + (", ..." if len(names) > 8 else "")
    return f"it contains {listed}" if names else "it is empty"


def _has(*names: str) -> Callable[[Path], bool]:
    return lambda path: all((path / name).exists() for name in names)


def _ends_in(*suffixes: str) -> Callable[[Path], bool]:
    return lambda path: path.suffix.lower() in suffixes


def _is_realsense(path: Path) -> bool:
    if path.suffix != ".bag":
        return False
    with Bag(path) as bag:
        return is_realsense(bag.topics)


def _has_bag(path: Path) -> bool:
    return (path / METADATA_FILE).is_file() or any(next(path.glob(f"*{suffix}"), None) for suffix in BAG_SUFFIXES)


def _is_bonn(path: Path) -> bool:
    return _has("rgb.txt", "depth.txt")(path) and any(_BONN.search(name.lower()) for name in names_of(path))


def _is_record3d(path: Path) -> bool:
    inside = path / "EXR_RGBD" if (path / "EXR_RGBD").is_dir() else path
    has_images = (inside / "rgbd").is_dir() or next(inside.glob("depth/*.exr"), None) is not None
    return has_images and any((inside / name).is_file() for name in METADATA_FILES)


def _is_scannetpp(path: Path) -> bool:
    return (path / SCANNETPP_FILE).is_file() or (path / "iphone" / SCANNETPP_FILE).is_file()


def _is_arkitscenes(path: Path) -> bool:
    inside = [path, *path.glob("*_frames")]
    return any(
        (folder / ARKITSCENES_DEPTH).is_dir() and any((folder / name).is_dir() for name in ARKITSCENES_FOLDERS)
        for folder in inside
    )


def _is_seven_scenes(path: Path) -> bool:
    return any(next(path.glob(pattern), None) for pattern in ("frame-*.color.*", "seq-*/frame-*.color.*"))


def _is_scannet(path: Path) -> bool:
    exported = any(_has("color", "depth", "pose", "intrinsic")(folder) for folder in (path, path / "frames"))
    return exported or len(list(path.glob("*.sens"))) == 1


def _is_open3d(path: Path) -> bool:
    if not (path / "depth").is_dir():
        return find_folder(path, ("*-color",)) is not None and find_folder(path, ("*-depth*",)) is not None
    if _is_folder(path) and any((path / name).is_file() for name in (POSES_FILE, TIMES_FILE)):
        return False  # no recorder of Open3D writes these, and as its recording they would not be read
    has_color = any((path / name).is_dir() for name in COLOR_FOLDERS)
    named = any((path / name).is_file() for name in _OPEN3D_INTRINSICS)
    return has_color and (named or trajectory_file(path) is not None)


def _is_video(path: Path) -> bool:
    has_color = any((path / name).is_dir() for name in COLOR_FOLDERS)
    return (path / "depth").is_dir() and not has_color and find_video(path) is not None


def _is_folder(path: Path) -> bool:
    has_color = any((path / name).is_dir() for name in COLOR_FOLDERS)
    return (path / "depth").is_dir() and has_color and any((path / name).is_file() for name in INTRINSICS_FILES)


# In the order in which they are tried: what has the most particular names comes first.
_FILES: tuple[tuple[str, str, Callable[[Path], bool]], ...] = (
    ("realsense", "a RealSense recording", _is_realsense),
    ("rosbag", "a ROS bag", _ends_in(*BAG_SUFFIXES)),
    ("azure_kinect", "an Azure Kinect recording", _ends_in(".mkv")),
    ("record3d", "a Record3D recording", _ends_in(".r3d")),
    ("scannet", "a ScanNet scan", _ends_in(".sens")),
)
_FOLDERS: tuple[tuple[str, str, Callable[[Path], bool]], ...] = (
    ("stray_scanner", "a Stray Scanner recording", _has("rgb.mp4", ODOMETRY_FILE, "depth")),
    ("record3d", "a Record3D recording", _is_record3d),
    ("scannetpp", "the iPhone recording of a ScanNet++ scene", _is_scannetpp),
    ("arkitscenes", "a recording of ARKitScenes", _is_arkitscenes),
    ("bonn", "a sequence of the Bonn RGB-D Dynamic Dataset", _is_bonn),
    ("tum", "a sequence in the layout of TUM RGB-D", _has("rgb.txt", "depth.txt")),
    ("icl_nuim", "a sequence of ICL-NUIM", _has(ASSOCIATIONS_FILE, "rgb", "depth")),
    ("replica", "a room of Replica in the layout of NICE-SLAM", _has("results", "traj.txt")),
    ("7scenes", "a scene or a sequence of 7-Scenes", _is_seven_scenes),
    ("synthetic_rgbd", "a room in the layout of Neural RGB-D", _has("images", "focal.txt")),
    ("scannet", "a ScanNet scan", _is_scannet),
    ("open3d", "a recording of Open3D or Redwood", _is_open3d),
    ("rosbag", "a ROS bag", _has_bag),
    ("video", "a video beside depth images", _is_video),
    ("folder", "a folder of color and depth images", _is_folder),
)
