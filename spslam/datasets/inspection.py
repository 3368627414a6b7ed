"""Inspection of a dataset before a run: sizes, depth, missing depth, poses, and what looks wrong."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

from spslam.camera import Camera
from spslam.datasets.base import RgbdDataset
from spslam.datasets.frozen_depth import FrameSignature, FrozenDepth
from spslam.datasets.reprojection import (
    Agreement,
    DepthPair,
    choose_pairs,
    explain_disagreement,
    measure_agreement,
)
from spslam.errors import DatasetError
from spslam.geometry import inverse, rotation_angle

# Indoors; a median outside it means another unit.
_PLAUSIBLE_MEDIAN_M = (0.1, 20.0)
_MANY_HOLES = 0.5
# A hand-held camera at 30 Hz moves less from frame to frame, and so does one at 10 Hz seldom.
_JUMP_M = 0.3
_JUMP_DEG = 20.0
_GOOD_AGREEMENT = 0.02
# Of a larger depth image only every n-th row and column is kept, so that many of them fit into memory.
_MAX_PIXELS_KEPT = 1 << 19


@dataclass(frozen=True)
class DepthStatistics:
    """Depth of the frames that were inspected.

    Attributes:
        near_m: 1st percentile.
        median_m: 50th percentile.
        far_m: 99th percentile.
        holes: mean share of pixels without depth.
        most_holes: largest share of pixels without depth in a frame.
    """

    near_m: float
    median_m: float
    far_m: float
    holes: float
    most_holes: float


@dataclass(frozen=True)
class PoseStatistics:
    """Ground-truth poses.

    Attributes:
        count: frames with a known pose.
        step_cm: median translation from frame to frame.
        max_step_cm: largest one.
        step_deg: median rotation from frame to frame.
        max_step_deg: largest one.
        jumps: frames after which the camera jumps.
        agreement: of the poses with the depth images; None where no pair of views overlaps.
    """

    count: int
    step_cm: float
    max_step_cm: float
    step_deg: float
    max_step_deg: float
    jumps: list[int]
    agreement: Agreement | None


@dataclass
class Inspection:
    """What was found.

    Attributes:
        name: of the dataset.
        frames: how many it has.
        camera: of all frames.
        frames_read: how many were inspected.
        unreadable: errors of those that can't be read.
        frames_per_second: from the median step between timestamps; NaN where unknown.
        depth: None where no frame has depth.
        poses: None where none is known.
        problems: what looks wrong, in words.
    """

    name: str
    frames: int
    camera: Camera
    frames_read: int
    unreadable: list[str]
    frames_per_second: float
    depth: DepthStatistics | None
    poses: PoseStatistics | None
    problems: list[str] = field(default_factory=list)


def inspect_dataset(dataset: RgbdDataset, frames: int = 40, pairs: int = 12) -> Inspection:
    """Reads some frames, spread evenly, and all poses and times.

    A frame that can't be read is reported, not raised. Deterministic. Of images of more than half a million pixels
    every n-th row and column is looked at.

    Args:
        dataset: what to inspect.
        frames: most frames whose depth is read.
        pairs: most pairs of frames that check the poses.
    """
    indices = np.unique(np.linspace(0, len(dataset) - 1, frames).astype(int))
    depths, unreadable = _read_depths(dataset, indices)
    poses, problem = _inspect_poses(dataset, pairs)
    found = Inspection(
        dataset.name,
        len(dataset),
        dataset.camera,
        len(indices),
        unreadable,
        _frames_per_second(dataset.timestamps()),
        _depth_statistics(depths),
        poses,
    )
    frozen = _frozen_frames(dataset, indices[:: max(1, len(indices) // pairs)])
    found.problems = [
        *_depth_problems(found),
        *_frozen_problems(frozen),
        *_pose_problems(found, problem),
        *_time_problems(dataset.timestamps()),
    ]
    return found


def _read_depths(dataset: RgbdDataset, indices: np.ndarray) -> tuple[list[np.ndarray], list[str]]:
    depths, unreadable = [], []
    for index in indices:
        try:
            depths.append(_thinned(dataset[int(index)].depth))
        except DatasetError as error:
            unreadable.append(str(error))
    return depths, unreadable


def _frozen_frames(dataset: RgbdDataset, indices: np.ndarray) -> list[int]:
    """Frames behind the given ones whose depth image is that of the frame before, but not their color."""
    frozen = []
    for index in indices[indices + 1 < len(dataset)]:
        check = FrozenDepth()
        try:
            if any([check.check(FrameSignature.of(dataset[int(i)])) for i in (index, index + 1)]):
                frozen.append(int(index) + 1)
        except DatasetError:
            continue
    return frozen


def _frozen_problems(frozen: list[int]) -> list[str]:
    if not frozen:
        return []
    listed = ", ".join(map(str, frozen[:5])) + (", ..." if len(frozen) > 5 else "")
    return [f"depth is frozen: the same image as in the frame before, but another color image, in frame {listed}"]


def _thinning(height: int, width: int) -> int:
    """Every how many rows and columns are kept."""
    return math.ceil(math.sqrt(height * width / _MAX_PIXELS_KEPT))


def _thinned(depth: np.ndarray) -> np.ndarray:
    """The rows and columns that are kept; a copy where that is not all, so that the whole image can go."""
    step = _thinning(*depth.shape)
    return depth if step == 1 else depth[::step, ::step].copy()


def _thinned_camera(camera: Camera) -> Camera:
    """The camera of thinned images: pixel (i, j) is pixel (n i, n j) of the whole one."""
    step = _thinning(camera.height, camera.width)
    if step == 1:
        return camera
    width, height = -(-camera.width // step), -(-camera.height // step)
    return Camera(width, height, camera.fx / step, camera.fy / step, camera.cx / step, camera.cy / step)


def _frames_per_second(timestamps: np.ndarray) -> float:
    steps = np.diff(timestamps)
    return float(1 / np.median(steps)) if len(steps) and np.median(steps) > 0 else float("nan")


def _depth_statistics(depths: list[np.ndarray]) -> DepthStatistics | None:
    measured = np.concatenate([depth[depth > 0] for depth in depths] or [np.zeros(0)])
    if not len(measured):
        return None
    near, median, far = (float(value) for value in np.percentile(measured, (1, 50, 99)))
    holes = [float(np.mean(depth == 0)) for depth in depths]
    return DepthStatistics(near, median, far, float(np.mean(holes)), max(holes))


def _inspect_poses(dataset: RgbdDataset, pairs: int) -> tuple[PoseStatistics | None, str | None]:
    poses = dataset.poses()
    if poses is None:
        return None, None
    known = np.isfinite(poses).all(axis=(1, 2))
    both = np.flatnonzero(known[:-1] & known[1:])
    motion = inverse(poses[both]) @ poses[both + 1]
    steps_cm = 100 * np.linalg.norm(motion[:, :3, 3], axis=1)
    steps_deg = np.degrees(rotation_angle(motion[:, :3, :3]))
    jumps = both[(steps_cm > 100 * _JUMP_M) | (steps_deg > _JUMP_DEG)]
    views = _read_pairs(dataset, choose_pairs(poses, pairs))
    camera = _thinned_camera(dataset.camera)
    agreement = measure_agreement(camera, views, poses)
    statistics = PoseStatistics(
        int(known.sum()), *_median_and_max(steps_cm), *_median_and_max(steps_deg), jumps.tolist(), agreement
    )
    return statistics, explain_disagreement(camera, views, poses, agreement) if views else None


def _read_pairs(dataset: RgbdDataset, pairs: list[tuple[int, int]]) -> list[DepthPair]:
    views = []
    for a, b in pairs:
        try:
            views.append(DepthPair(a, b, _thinned(dataset[a].depth), _thinned(dataset[b].depth)))
        except DatasetError:
            continue
    return views


def _median_and_max(values: np.ndarray) -> tuple[float, float]:
    return (float(np.median(values)), float(values.max())) if len(values) else (0.0, 0.0)


def _depth_problems(found: Inspection) -> list[str]:
    problems = [f"unreadable: {message}" for message in found.unreadable]
    if found.depth is None:
        return [*problems, "no depth at all in the frames looked at"]
    low, high = _PLAUSIBLE_MEDIAN_M
    if not low <= found.depth.median_m <= high:
        problems.append(f"median depth of {found.depth.median_m:.3g} m: the depth scale looks wrong")
    if found.depth.holes > _MANY_HOLES:
        problems.append(f"{found.depth.holes:.0%} of the pixels have no depth")
    return problems


def _pose_problems(found: Inspection, explanation: str | None) -> list[str]:
    poses = found.poses
    if poses is None:
        return []
    problems = []
    if poses.count < found.frames:
        problems.append(f"{found.frames - poses.count} of {found.frames} frames have no ground-truth pose")
    if poses.jumps:
        listed = ", ".join(map(str, poses.jumps[:5])) + (", ..." if len(poses.jumps) > 5 else "")
        problems.append(
            f"{len(poses.jumps)} jumps over {100 * _JUMP_M:.0f} cm or {_JUMP_DEG:.0f} deg after frame {listed}"
        )
    if explanation is not None:
        problems.append(explanation)
    elif poses.agreement is None and poses.count > 1:
        problems.append("no view overlaps with one a little later by the ground-truth poses: they look wrong")
    elif poses.agreement is not None and poses.agreement.relative > _GOOD_AGREEMENT:
        problems.append(
            f"depth and ground-truth poses disagree by {poses.agreement.median_cm:.1f} cm: poses or intrinsics are off"
        )
    return problems


def _time_problems(timestamps: np.ndarray) -> list[str]:
    steps = np.diff(timestamps)
    if not len(steps):
        return ["only one frame"]
    problems = []
    if np.any(steps <= 0):
        problems.append(f"timestamps don't ascend after frame {int(np.argmax(steps <= 0))}")
    gaps = np.flatnonzero(steps > 10 * max(np.median(steps), 1e-9))
    if len(gaps):
        problems.append(f"{len(gaps)} gaps in time, the longest {steps.max():.2f} s after frame {int(steps.argmax())}")
    return problems
