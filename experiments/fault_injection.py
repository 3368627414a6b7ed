"""Fault injection: frames of a covered, moved or interrupted camera, and what the system does with them.

A trial is a run up to some frame, then a fault, then frames near a place that was mapped before. Every second frame of
the dataset is mapped, and the camera returns with frames in between, so that no frame is processed twice.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
import torch

from spslam.config import Config
from spslam.datasets.base import RgbdDataset, RgbdFrame
from spslam.errors import DatasetError
from spslam.geometry import inverse, rotation_angle
from spslam.run.clock import RunClock
from spslam.slam.checkpoint import load_checkpoint, take_snapshot, write_snapshot
from spslam.slam.system import SlamSystem

STEP = 2  # between mapped frames; the frames in between are for the way back
FRAMES_PER_SECOND = 30
BLACK_FRAMES, JUMP_FRAMES, COVERED_FRAMES, BACK_FRAMES = 30, 60, 20, 15
FOUND_CM, FOUND_DEG = 3.0, 3.0
WRONG_CM, WRONG_DEG = 8.0, 6.0  # ground truth and map differ by a few centimeters anyway
FLAG_WITHIN, RECOVER_WITHIN = 3, 10

Change = Callable[[RgbdFrame, np.random.Generator], None]


def black_out(frame: RgbdFrame, random: np.random.Generator) -> None:
    """A black frame without depth."""
    frame.color[:], frame.depth[:] = 0, 0


def cover_near(frame: RgbdFrame, random: np.random.Generator) -> None:
    """A flat dark surface 40 cm in front of the lens, with noise and holes."""
    slope = np.linspace(-0.02, 0.02, frame.depth.shape[1], dtype=np.float32)
    frame.depth[:] = 0.4 + slope + random.normal(0, 0.004, frame.depth.shape)
    frame.depth[random.random(frame.depth.shape) < 0.2] = 0
    frame.color[:] = random.integers(20, 40, frame.color.shape)


def cover_garbage(frame: RgbdFrame, random: np.random.Generator) -> None:
    """A sensor without signal: random depth from 0.3 to 4 m, half of it missing."""
    frame.depth[:] = random.uniform(0.3, 4, frame.depth.shape)
    frame.depth[random.random(frame.depth.shape) < 0.5] = 0
    frame.color[:] = random.integers(0, 255, frame.color.shape)


def cover_wall(frame: RgbdFrame, random: np.random.Generator) -> None:
    """Depth of a plane at 1.5 m, which can be mistaken for a wall."""
    frame.depth[:] = 1.5 + random.normal(0, 0.005, frame.depth.shape)
    frame.color[:] = 90


COVERS = (cover_near, cover_garbage, cover_wall)


@dataclass(frozen=True)
class Shown:
    """A frame of a trial: its index in the dataset, and the change that the fault makes to it."""

    index: int
    change: Change | None = None


@dataclass(frozen=True)
class Trial:
    """A fault after `place` frames of the run, and the way back.

    Attributes:
        fault: name of the fault.
        place: number of mapped frames before it.
        during: frames shown during the fault; empty where the camera only moves elsewhere.
        back: frames near a place that was mapped.
        seed: of the fault's random draws.
    """

    fault: str
    place: int
    during: tuple[Shown, ...]
    back: tuple[Shown, ...]
    seed: int


@dataclass(frozen=True)
class Outcome:
    """Result of a trial.

    Attributes:
        trial: the trial.
        flagged_after: number of frames from the first wrong pose to the first one flagged as lost, 1 if it is the same
            frame; 0 where no pose was wrong.
        wrong_unflagged: number of wrong poses that were not flagged as lost.
        recovered_after: number of frames of the way back up to the first pose within 3 cm; None where there is none.
        error_cm: position error at the end; infinite if lost.
        voxels_added: voxels allocated by frames of the fault whose pose was wrong.
        seen: frames between the fault and the return that show something.
        kept: how many of them have a pose in the map at the end.
        kept_apart: how many more have one in a map of their own that did not join.
    """

    trial: Trial
    flagged_after: int
    wrong_unflagged: int
    recovered_after: int | None
    error_cm: float
    voxels_added: int
    seen: int = 0
    kept: int = 0
    kept_apart: int = 0

    @property
    def passed(self) -> bool:
        """Whether the fault was flagged within 3 frames and the camera recovered within 10."""
        return (
            self.flagged_after <= FLAG_WITHIN
            and self.recovered_after is not None
            and self.recovered_after <= RECOVER_WITHIN
        )


def plan(dataset: RgbdDataset, count: int, seed: int) -> list[Trial]:
    """`count` trials of each fault, at places spread over the run, each with another place to return to."""
    random = np.random.default_rng(seed)
    rows = len(dataset) // STEP
    places = np.linspace(0.25 * rows, rows - JUMP_FRAMES // STEP - BLACK_FRAMES // STEP - 2, count).astype(int)
    trials: list[Trial] = []
    for place in places.tolist():
        ahead = [STEP * place + i for i in range(BLACK_FRAMES)]
        goal = int(random.integers(0, max(place - BACK_FRAMES, 1)))
        start = [Shown(STEP * i + 1) for i in range(BACK_FRAMES)]
        back = tuple(Shown(STEP * (goal + i) + 1) for i in range(BACK_FRAMES))
        cover = COVERS[len(trials) // 4 % len(COVERS)]
        jump = STEP * place + JUMP_FRAMES
        shown = {
            "black-out": (tuple(Shown(i, black_out) for i in ahead), back),
            "cover": (tuple(Shown(i, cover) for i in ahead[:COVERED_FRAMES]), back),
            "jump": (tuple(Shown(jump + i) for i in range(BACK_FRAMES)), back),
            "return": ((), tuple(start)),
        }
        for i, (fault, (during, after)) in enumerate(shown.items()):
            trials.append(Trial(fault, place, during, after, seed + 4 * place + i))
    return sorted(trials, key=lambda trial: trial.place)


def plan_black_outs(
    dataset: RgbdDataset, count: int, seed: int, seconds: Sequence[float], between: int = 0
) -> list[Trial]:
    """`count` black-outs of each length, at places spread over the run, each with another mapped place to return to.

    Args:
        dataset: with ground-truth poses.
        count: trials of each length.
        seed: of the places to return to.
        seconds: lengths of the black-outs.
        between: frames that the camera sees between the black-out and its return: those that it has moved on to
            meanwhile, known or not. A recording too short for them has fewer.
    """
    random = np.random.default_rng(seed)
    rows = len(dataset) // STEP
    trials = []
    for place in np.linspace(0.25 * rows, rows - 1, count).astype(int).tolist():
        for length in seconds:
            goal = int(random.integers(0, max(place - BACK_FRAMES, 1)))
            black = round(length * FRAMES_PER_SECOND)
            during = [Shown(STEP * place, black_out)] * black
            ahead = min(STEP * place + black, len(dataset) - between)
            during += [Shown(i) for i in range(max(ahead, STEP * place), min(ahead + between, len(dataset)))]
            back = tuple(Shown(STEP * (goal + i) + 1) for i in range(BACK_FRAMES))
            trials.append(Trial(f"black-out of {length:g} s", place, tuple(during), back, seed + place))
    return trials


def run_trials(config: Config, dataset: RgbdDataset, trials: list[Trial], device: torch.device) -> Iterator[Outcome]:
    """Maps every second frame, and runs each trial on a copy of the system at the trial's place.

    Args:
        config: of the system.
        dataset: with ground-truth poses.
        trials: as `plan` gives them.
        device: of the system.

    Yields:
        The outcome of each trial, in the order of their places.

    Raises:
        DatasetError: a frame before a fault is lost, so that there is nothing to compare with, or the dataset has no
            ground truth.
    """
    ground_truth = gt_poses(dataset)
    system = SlamSystem(config, dataset.camera, ground_truth[0], device)
    with tempfile.TemporaryDirectory() as folder:
        for trial in sorted(trials, key=lambda trial: trial.place):
            while len(system.state.frames) < trial.place:
                if system.process(dataset[STEP * len(system.state.frames)]).lost:
                    raise DatasetError(f"{dataset.name}: frame {len(system.state.frames) - 1} of a clean run is lost")
            yield try_fault(copy_of(system, ground_truth[0], Path(folder) / "state"), dataset, trial)


def try_fault(system: SlamSystem, dataset: RgbdDataset, trial: Trial) -> Outcome:
    """Runs one trial on a system that has mapped `trial.place` frames; the system is not usable afterwards."""
    random, ground_truth = np.random.default_rng(trial.seed), gt_poses(dataset)
    first = len(system.state.frames)
    lost, wrong, errors, added = [], [], [], 0
    for i, shown in enumerate((*trial.during, *trial.back)):
        voxels = system.state.scene.volume.num_voxels
        timestamp = float(system.state.frames.timestamps[-1]) + 1 / FRAMES_PER_SECOND
        report = system.process(replace(_shown_frame(dataset, shown, random), timestamp=timestamp))
        apart_cm, apart_deg = _error(system, ground_truth, trial.place, shown.index)
        lost.append(report.lost)
        is_black = shown.change is not None
        wrong.append(is_black or apart_cm > WRONG_CM or apart_deg > WRONG_DEG)
        if i >= len(trial.during):
            errors.append(np.inf if report.lost or apart_deg > FOUND_DEG else apart_cm)
        elif wrong[-1] and not report.lost:
            added += system.state.scene.volume.num_voxels - voxels
    found = [i for i, error in enumerate(errors, 1) if error < FOUND_CM]
    unflagged = [a and not b for a, b in zip(wrong, lost, strict=True)]
    return Outcome(
        trial,
        _flagged_after(unflagged, wrong),
        sum(unflagged),
        found[0] if found else None,
        errors[-1],
        added,
        *_kept(system, [first + i for i, shown in enumerate(trial.during) if shown.change is None]),
    )


def _kept(system: SlamSystem, numbers: Sequence[int]) -> tuple[int, int, int]:
    """How many frames there are of given numbers, how many have a pose in the map, and how many in one apart."""
    in_map = {number for number in numbers if not system.state.frames.lost[number]}
    segment = system.state.segment
    apart = {int(n) for unjoined in system.state.unjoined for n in unjoined.rows}
    if segment is not None:
        apart |= {segment.first + int(n) for n in (~segment.state.frames.lost).nonzero()[:, 0]}
    return len(numbers), len(in_map), len((apart & set(numbers)) - in_map)


def _flagged_after(unflagged: list[bool], wrong: list[bool]) -> int:
    """Frames from the first wrong pose to the first one flagged as lost; 0 if none is wrong."""
    if not any(wrong):
        return 0
    first = wrong.index(True)
    return unflagged.index(False, first) - first + 1 if False in unflagged[first:] else len(wrong)


def _shown_frame(dataset: RgbdDataset, shown: Shown, random: np.random.Generator) -> RgbdFrame:
    frame = dataset[shown.index]
    if shown.change is not None:
        shown.change(frame, random)
    return frame


def _error(system: SlamSystem, ground_truth: np.ndarray, place: int, index: int) -> tuple[float, float]:
    """Distance (cm) and angle (degrees) of the last pose from the expected pose of a dataset's frame."""
    return apart(system.state.frames.matrices(-1)[0], expected_pose(system, ground_truth, place, index))


def expected_pose(system: SlamSystem, ground_truth: np.ndarray, place: int, index: int, step: int = STEP) -> np.ndarray:
    """Expected pose of a frame in the map: the nearest mapped frame's estimated pose, moved by the true motion from it.

    So neither drift of the map nor errors of the ground truth over long distances count.

    Args:
        system: has mapped `place` frames.
        ground_truth: float64 [F, 4, 4] of the dataset.
        place: number of mapped frames.
        index: of the frame in the dataset.
        step: between mapped frames.

    Returns:
        float64 [4, 4] T_world_camera.
    """
    mapped = ground_truth[: step * place : step]
    turned = rotation_angle(np.swapaxes(mapped[:, :3, :3], 1, 2) @ ground_truth[index, :3, :3])
    nearest = int(np.argmin(np.linalg.norm(mapped[:, :3, 3] - ground_truth[index, :3, 3], axis=1) + turned))
    return system.state.frames.matrices()[nearest] @ inverse(mapped[nearest]) @ ground_truth[index]


def apart(pose: np.ndarray, other: np.ndarray) -> tuple[float, float]:
    """Distance (cm) and angle (degrees) between two poses [4, 4]."""
    angle = rotation_angle(pose[:3, :3].T @ other[:3, :3])
    return 100 * float(np.linalg.norm(pose[:3, 3] - other[:3, 3])), float(np.degrees(angle))


def gt_poses(dataset: RgbdDataset) -> np.ndarray:
    """Ground-truth poses float64 [F, 4, 4]; raises DatasetError where there are none."""
    poses = dataset.poses()
    if poses is None:
        raise DatasetError(f"{dataset.name}: must have ground-truth poses to inject faults, got none")
    return poses


def copy_of(system: SlamSystem, first_pose: np.ndarray, path: Path) -> SlamSystem:
    """A copy of the system, made through a checkpoint at `path`."""
    frames = len(system.state.frames)
    source = {"data": {"frames": frames}, "next": frames, "clock": asdict(RunClock())}
    write_snapshot(path, take_snapshot(system.state, system.config, source, copy=False))
    copy = SlamSystem(system.config, system.camera, first_pose, system.device)
    load_checkpoint(path, copy.state, copy.config)
    return copy
