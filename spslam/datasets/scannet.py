"""ScanNet (Dai et al. 2017): Structure Sensor on a tablet, poses by BundleFusion.

A scan is read from `sceneNNNN_NN.sens` as it is distributed, or from what the dataset's own exporter makes of it:
`color/N.jpg`, `depth/N.png` (16-bit millimeters), `pose/N.txt` (4x4 camera to world, OpenCV axes; infinite where
unknown) and `intrinsic/intrinsic_depth.txt`. Color is larger than depth (1296x968 against 640x480). The authors
registered the two to each other ("they can be resampled to the same resolution"), so color is brought to depth's size
and depth's intrinsics hold for both.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from spslam.camera import Camera
from spslam.datasets.base import RgbdDataset, RgbdFrame
from spslam.datasets.files import FileDataset, find_numbered, pair_numbered, require_folder
from spslam.datasets.images import depth_in_meters, first_size, read_depth, resized_color
from spslam.datasets.reference_poses import ReferencePoses, file_poses
from spslam.datasets.sens import SensFile
from spslam.datasets.text import camera_from_matrix, checked_poses, motion_fault, read_intrinsics_matrix
from spslam.errors import DatasetError

FRAMES_PER_SECOND = 30.0
_COLOR_NAME, _DEPTH_NAME, _POSE_NAME = r"(\d+)\.(?:jpg|jpeg|png)", r"(\d+)\.png", r"(\d+)\.txt"
_INTRINSICS = "intrinsic_depth.txt", "intrinsic_color.txt"


def open_scannet(path: Path) -> RgbdDataset:
    """Opens a scan.

    A frame whose pose isn't finite or is no rigid motion has no pose; the latter is a doubt. A frame whose image is
    missing or broken is one that raises when it is read.

    Args:
        path: the `.sens` file, the folder that holds one, or an exported folder (which wins if both are there).

    Raises:
        DatasetError: a missing path, another layout, several `.sens` files, missing or unreadable intrinsics.
    """
    if path.suffix == ".sens":
        return SensDataset(SensFile(path))
    for folder in (require_folder(path), path / "frames"):
        if (folder / "color").is_dir() and (folder / "depth").is_dir():
            return _open_exported(folder, f"scannet/{path.name}")
    files = sorted(path.glob("*.sens"))
    if len(files) != 1:
        raise DatasetError(
            f"{path}: must contain one .sens file, or the folders color and depth exported from one, "
            f"got {', '.join(file.name for file in files) or 'neither'}"
        )
    return SensDataset(SensFile(files[0]))


class SensDataset(RgbdDataset):
    """The frames of a `.sens` file.

    Times are those of the color images, in seconds from the first; a file without times is taken at 30 Hz. Frames are
    put in order of time; of frames with the same time all but the first raise when they are read, and so does one frame
    that stands for the missing rest of a truncated file.

    Args:
        file: opened.

    Raises:
        DatasetError: the file has no whole frame, or no intrinsics of depth.
    """

    is_random_access = True

    def __init__(self, file: SensFile) -> None:
        header, index = file.header, file.index
        if not len(index):
            raise DatasetError(f"{file.path}: must contain a whole frame, got none of {header.frames}")
        self.name = f"scannet/{file.path.stem}"
        self.camera = _sens_camera(file)
        self._file = file
        self._times, self._order = _ordered_times(index.times_us)
        self._faults = {
            int(row): f"{file.describe(self._order[row])}: must be later than frame {self._order[row - 1]}, "
            f"got the same time {self._times[row]:g} s"
            for row in np.flatnonzero(np.diff(self._times, prepend=-1.0) <= 0)
        }
        self._poses = self._read_poses(index.poses)
        if len(index) < header.frames:
            self._stand_in_for_the_rest(header.frames)

    def __len__(self) -> int:
        return len(self._times)

    def timestamps(self) -> np.ndarray:
        return self._times.copy()

    def poses(self) -> np.ndarray | None:
        return self._poses.copy() if np.isfinite(self._poses).any() else None

    def read(self, index: int) -> RgbdFrame:
        color = resized_color(self._file.color(self._usable(index)), self.camera.width, self.camera.height)
        depth = self.read_depth(index)
        pose = self._poses[index]
        return RgbdFrame(
            index, float(self._times[index]), color, depth, pose.copy() if np.isfinite(pose).all() else None
        )

    def read_depth(self, index: int) -> np.ndarray:
        return depth_in_meters(self._file.depth(self._usable(index)), self._file.header.units_per_meter)

    def _usable(self, index: int) -> int:
        """A frame's number in the file."""
        if index in self._faults:
            raise DatasetError(self._faults[index])
        return int(self._order[index])

    def describe(self, index: int) -> str:
        return self._file.describe(int(self._order[index]))

    def _read_poses(self, stored: np.ndarray) -> np.ndarray:
        ordered = stored[self._order]
        poses, is_motion = checked_poses(ordered.reshape(-1, 4, 4))
        damaged = [
            motion_fault(f"{self._file.describe(self._order[row])}, pose", ordered[row])
            for row in np.flatnonzero(~is_motion)
        ]
        self.doubts = ReferencePoses.of(poses, damaged, f"the poses in {self._file.path}").doubts
        return poses

    def _stand_in_for_the_rest(self, announced: int) -> None:
        found = len(self._order)
        self._faults[found] = f"{self._file.path}: the file is truncated: {found} of {announced} frames are whole"
        self._times = np.append(self._times, self._times[-1] + 1 / FRAMES_PER_SECOND)
        self._order = np.append(self._order, found)
        self._poses = np.append(self._poses, np.full((1, 4, 4), np.nan), axis=0)


def _sens_camera(file: SensFile) -> Camera:
    header = file.header
    matrix, (width, height) = header.depth_intrinsics.astype(np.float64), header.depth_size
    return camera_from_matrix(matrix, width, height, f"{file.path}, intrinsics of depth")


def _ordered_times(times_us: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Seconds from the first, ascending, and the frames in that order."""
    if (times_us == times_us[0]).all():
        return np.arange(len(times_us)) / FRAMES_PER_SECOND, np.arange(len(times_us))
    order = np.argsort(times_us, kind="stable")
    return (times_us[order] - times_us[order[0]]).astype(np.float64) / 1e6, order


def _open_exported(folder: Path, name: str) -> FileDataset:
    colors, depths = find_numbered(folder / "color", _COLOR_NAME), find_numbered(folder / "depth", _DEPTH_NAME)
    if not colors or not depths:
        empty = folder / ("depth" if colors else "color")
        raise DatasetError(f"{empty}: must contain a ScanNet scan's images (0.jpg, 0.png, ...), got none")
    size = first_size(depths.values(), lambda path: read_depth(path, 1000.0))
    camera = _find_camera(folder, size, list(colors.values()))
    paired = pair_numbered(colors, depths, FRAMES_PER_SECOND)
    reference = file_poses(list(paired), find_numbered(folder / "pose", _POSE_NAME))
    frames, doubts = list(paired.values()), reference.doubts
    return FileDataset(name, camera, frames, reference.poses, units_per_meter=1000.0, resize_color=True, doubts=doubts)


def _find_camera(folder: Path, size: tuple[int, int], colors: list[Path]) -> Camera:
    for parent in (folder / "intrinsic", folder):
        if (parent / _INTRINSICS[0]).is_file():
            return read_intrinsics_matrix(parent / _INTRINSICS[0], *size)
    for parent in (folder / "intrinsic", folder):
        if (parent / _INTRINSICS[1]).is_file():
            return read_intrinsics_matrix(parent / _INTRINSICS[1], *first_size(colors)).resized(*size)
    raise DatasetError(f"{folder / 'intrinsic' / _INTRINSICS[0]}: no such file; it must contain depth's intrinsics")
