"""Inspection of a dataset before a run: sizes, depth, missing depth, poses, and what looks wrong."""

from __future__ import annotations

import re
from dataclasses import dataclass, field

import numpy as np

from spslam.camera import Camera
from spslam.datasets.base import RgbdDataset
from spslam.datasets.frozen_depth import frozen_frames
from spslam.datasets.plausibility import Finding, Judgment, check_stretch, folded, with_whole
from spslam.datasets.reprojection import (
    Agreement,
    DepthPair,
    choose_pairs,
    explain_disagreement,
    measure_agreement,
)
from spslam.datasets.thinning import thinned, thinned_camera
from spslam.errors import DatasetError
from spslam.geometry import inverse, rotation_angle

# Where the recording is looked at, as shares of its length, and how many views there.
_STRETCHES = (0.0, 0.4, 0.75)
_VIEWS_PER_STRETCH = 48
_MANY_HOLES = 0.5
# A hand-held camera at 30 Hz moves less from frame to frame, and so does one at 10 Hz seldom.
_JUMP_M = 0.3
_JUMP_DEG = 20.0
_GOOD_AGREEMENT = 0.02
# With these certainly wrong, depth can't be carried from view to view, and says nothing about poses.
_SPOILS_POSES = ("intrinsics", "depth", "pairing", "order")
_NAMES_AND_NUMBERS = re.compile(r"\S*[\d/]\S*")


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
        compared: pairs of views that both have depth.
    """

    count: int
    step_cm: float
    max_step_cm: float
    step_deg: float
    max_step_deg: float
    jumps: list[int]
    agreement: Agreement | None
    compared: int


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
        findings: what a look at a few stretches says of intrinsics, scale, pairing and order, and what opening said.
        focal_error: share by which the focal length looks too large by how color moves against depth, and its standard
            deviation; None where that can't be told.
        color_offset: from depth images to their color images, as stamps say: mean and standard deviation, s; None where
            all are of one moment, or nothing is known.
        problems: all that looks wrong, in words.
    """

    name: str
    frames: int
    camera: Camera
    frames_read: int
    unreadable: list[str]
    frames_per_second: float
    depth: DepthStatistics | None
    poses: PoseStatistics | None
    findings: list[Finding] = field(default_factory=list)
    focal_error: tuple[float, float] | None = None
    color_offset: tuple[float, float] | None = None
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
    depths, offsets, unreadable = _read_depths(dataset, indices)
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
    judgments = _judge_stretches(dataset, frames)
    of_stretches = folded(finding for judgment in judgments for finding in judgment.findings)
    found.findings = with_whole(dataset, of_stretches)
    found.focal_error = _focal_error(judgments)
    if any(offsets):
        found.color_offset = float(np.mean(offsets)), float(np.std(offsets))
    frozen = frozen_frames(dataset, indices[:: max(1, len(indices) // pairs)])
    found.problems = [
        *_depth_problems(found),
        *map(str, found.findings),
        *_frozen_problems(frozen, found.findings),
        *_pose_problems(found, problem),
        *_time_problems(dataset.timestamps(), found.findings),
        *dataset.remarks,
    ]
    return found


def _judge_stretches(dataset: RgbdDataset, frames: int) -> list[Judgment]:
    """Judgments of stretches that do not overlap; `frames` limits the views of each."""
    views = min(_VIEWS_PER_STRETCH, frames)
    starts = sorted({int(share * len(dataset)) for share in _STRETCHES})
    if len(dataset) < 4 * views:
        starts = starts[:1]
    return [check_stretch(dataset, start, views) for start in starts]


def _focal_error(judgments: list[Judgment]) -> tuple[float, float] | None:
    """By all stretches together."""
    estimates = [judgment.estimate for judgment in judgments if judgment.estimate is not None]
    if not estimates:
        return None
    weights = np.array([1 / estimate.sigma[0] ** 2 for estimate in estimates])
    focal = float(np.sum(weights * [estimate.focal for estimate in estimates]) / weights.sum())
    return float(np.expm1(-focal)), float(1 / np.sqrt(weights.sum()))


def _read_depths(dataset: RgbdDataset, indices: np.ndarray) -> tuple[list[np.ndarray], list[float], list[str]]:
    """Thinned depth images, the offsets of their colors (s), and what can't be read."""
    depths, offsets, unreadable = [], [], []
    for index in indices:
        try:
            frame = dataset[int(index)]
        except DatasetError as error:
            unreadable.append(str(error))
            continue
        depths.append(thinned(frame.depth))
        offsets.append(frame.offsets.color)
    return depths, offsets, unreadable


def _frozen_problems(frozen: list[int], findings: list[Finding]) -> list[str]:
    if not frozen or any(finding.kind.startswith("frozen") for finding in findings):
        return []
    listed = ", ".join(map(str, frozen[:5])) + (", ..." if len(frozen) > 5 else "")
    return [f"depth is frozen: the same image as in the frame before, but another color image, in frame {listed}"]


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
    camera = thinned_camera(dataset.camera)
    agreement = measure_agreement(camera, views, poses)
    compared = sum(bool((view.depth_a > 0).any() and (view.depth_b > 0).any()) for view in views)
    statistics = PoseStatistics(
        int(known.sum()), *_median_and_max(steps_cm), *_median_and_max(steps_deg), jumps.tolist(), agreement, compared
    )
    return statistics, explain_disagreement(camera, views, poses, agreement) if views else None


def _read_pairs(dataset: RgbdDataset, pairs: list[tuple[int, int]]) -> list[DepthPair]:
    views = []
    for a, b in pairs:
        try:
            views.append(DepthPair(a, b, thinned(dataset[a].depth), thinned(dataset[b].depth)))
        except DatasetError:
            continue
    return views


def _median_and_max(values: np.ndarray) -> tuple[float, float]:
    return (float(np.median(values)), float(values.max())) if len(values) else (0.0, 0.0)


def _depth_problems(found: Inspection) -> list[str]:
    problems = _folded_lines([f"unreadable: {message}" for message in found.unreadable])
    if found.depth is None:
        known = any(finding.kind in ("depth", "scale") for finding in found.findings)
        return problems if known else [*problems, "no depth at all in the frames looked at"]
    if found.depth.holes > _MANY_HOLES:
        problems.append(f"{found.depth.holes:.0%} of the pixels have no depth")
    return problems


def _folded_lines(lines: list[str]) -> list[str]:
    """Lines that differ in names and numbers only as one, with their number."""
    alike: dict[str, list[str]] = {}
    for line in lines:
        alike.setdefault(_NAMES_AND_NUMBERS.sub("#", line), []).append(line)
    return [same[0] + (f" (and {len(same) - 1} more like it)" if same[1:] else "") for same in alike.values()]


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
    if any(finding.certain and finding.kind in _SPOILS_POSES for finding in found.findings):
        return problems
    if explanation is not None:
        known = any(finding.text == explanation for finding in found.findings)
        problems += [] if known else [explanation]
    elif poses.agreement is None and poses.compared:
        problems.append("no view overlaps with one a little later by the ground-truth poses: they look wrong")
    elif poses.agreement is not None and poses.agreement.relative > _GOOD_AGREEMENT:
        problems.append(
            f"depth and ground-truth poses disagree by {poses.agreement.median_cm:.1f} cm: poses or intrinsics are off"
        )
    return problems


def _time_problems(timestamps: np.ndarray, findings: list[Finding]) -> list[str]:
    steps = np.diff(timestamps)
    if not len(steps):
        return ["only one frame"]
    problems = []
    if np.any(steps <= 0) and not any(finding.kind == "times" for finding in findings):
        problems.append(f"timestamps don't ascend after frame {int(np.argmax(steps <= 0))}")
    gaps = np.flatnonzero(steps > 10 * max(np.median(steps), 1e-9))
    if len(gaps):
        problems.append(f"{len(gaps)} gaps in time, the longest {steps.max():.2f} s after frame {int(steps.argmax())}")
    return problems
