"""A video beside a folder of depth images, and the intrinsics as in a `folder` recording.

The video is the only one in the folder, or `color`, `rgb` or `video` with a suffix of a video. Frame n of it belongs to
the n-th depth image by natural order if there are as many; otherwise times decide: `times.txt` has one (s) per depth
image, on the video's clock.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from spslam.datasets.calibration_files import read_calibration
from spslam.datasets.files import require_folder
from spslam.datasets.folder import DEPTH_SUFFIXES, POSES_FILE, SATURATED, TIMES_FILE, check_scale, list_images
from spslam.datasets.image_files import DepthFiles, first_depth_size
from spslam.datasets.images import DEPTH_SCALE_RULE, is_depth_scale
from spslam.datasets.pairing import pair_by_time
from spslam.datasets.recording import Recording, View
from spslam.datasets.reference_poses import table_poses
from spslam.datasets.text import read_numbers
from spslam.datasets.video import VIDEO_SUFFIXES, VideoStream
from spslam.errors import DatasetError

_NAMES = ("color", "rgb", "video")


def open_video_recording(
    folder: Path, depth_scale: float | None = None, tolerance_s: float = 0.02, view: View = "depth"
) -> Recording:
    """Opens a recording.

    Args:
        folder: holds the video, `depth/` and the intrinsics; poses may be in `poses.txt`, 16 numbers per depth image.
        depth_scale: depth units per meter; overrides the one in the JSON file.
        tolerance_s: images that are less apart are one frame, where times decide.
        view: see `Recording`.

    Raises:
        DatasetError: a missing folder or video, several videos, cameras that are not fully described, counts that
            differ without times, or another count of poses than of depth images.
    """
    path = find_video(require_folder(folder))
    if path is None:
        raise DatasetError(
            f"{folder}: must contain one video ({', '.join(VIDEO_SUFFIXES)}), or color{VIDEO_SUFFIXES[0]}"
        )
    depths = list_images(folder / "depth", DEPTH_SUFFIXES)
    video = VideoStream(path)
    size = first_depth_size(depths[:50])
    if size is None:
        raise DatasetError(f"{folder / 'depth'}: must contain depth images that can be read, got none")
    calibration, stored_scale = read_calibration(folder, video.index.size, size)
    scale = stored_scale if depth_scale is None else depth_scale
    if scale is not None and not is_depth_scale(scale):
        raise DatasetError(f"{folder}: depth_scale must be {DEPTH_SCALE_RULE}, got {scale}")
    check_scale(depths, scale)
    pairs, seconds = _pairs(folder, video, len(depths), tolerance_s)
    reference = table_poses(pairs[:, 1].tolist(), folder / POSES_FILE, (len(depths),))
    stream = DepthFiles(depths, seconds, size, scale, SATURATED)
    dataset = Recording(f"video/{folder.name}", video, stream, pairs, calibration, reference.poses, view=view)
    dataset.doubts = reference.doubts
    return dataset


def find_video(folder: Path) -> Path | None:
    """The video of a folder: the one of a known name, or the only one; None where there is none or no telling."""
    videos = sorted(path for path in folder.iterdir() if path.suffix.lower() in VIDEO_SUFFIXES and path.name[0] != ".")
    named = [path for name in _NAMES for path in videos if path.stem.lower() == name]
    return named[0] if named else videos[0] if len(videos) == 1 else None


def _pairs(folder: Path, video: VideoStream, depths: int, tolerance_s: float) -> tuple[np.ndarray, np.ndarray]:
    """Pairs [F, 2], and the times of the depth images."""
    path = folder / TIMES_FILE
    if path.is_file():
        seconds = read_numbers(path)
        if len(seconds) != depths or not np.isfinite(seconds).all() or (np.diff(seconds) <= 0).any():
            raise DatasetError(f"{path}: must have one finite, ascending time (s) for each of {depths} depth images")
        return pair_by_time(video.times(), seconds, tolerance_s, str(folder)), seconds
    if len(video) != depths:
        raise DatasetError(
            f"{folder}: the video must have as many frames as there are depth images, got {len(video)} and {depths}; "
            f"{TIMES_FILE}, with one time (s) per depth image, pairs them by time"
        )
    return np.repeat(np.arange(depths)[:, None], 2, axis=1), video.times()
