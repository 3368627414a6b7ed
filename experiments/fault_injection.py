"""Faults injected into a sequence: what a camera shows when it is covered, carried or cut off, and what becomes of it.

A trial is a run up to a place, a fault, and then frames near a place that was seen before. Every second frame of the
data set is mapped and the camera comes back with the others, so that no frame is seen twice.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from spslam.config import Config
from spslam.datasets.base import RgbdDataset, RgbdFrame
from spslam.errors import DatasetError
from spslam.geometry import inverse, rotation_angle
from spslam.slam.checkpoint import load_checkpoint, take_snapshot, write_snapshot
from spslam.slam.system import SlamSystem

STEP = 2  # of the mapped frames; those between are for the way back
BLACK_FRAMES, JUMP_FRAMES, COVERED_FRAMES, BACK_FRAMES = 30, 60, 20, 15
FOUND_CM, FOUND_DEG = 3.0, 3.0
WRONG_CM, WRONG_DEG = 8.0, 6.0  # truth and map disagree by a few centimeters by themselves
FLAG_WITHIN, RECOVER_WITHIN = 3, 10

Change = Callable[[RgbdFrame, np.random.Generator], None]


def black_out(frame: RgbdFrame, random: np.random.Generator) -> None:
    """Neither light nor depth."""
    frame.color[:], frame.depth[:] = 0, 0


def cover_near(frame: RgbdFrame, random: np.random.Generator) -> None:
    """Something flat and dark some 40 cm before the lens, with noise and holes."""
    slope = np.linspace(-0.02, 0.02, frame.depth.shape[1], dtype=np.float32)
    frame.depth[:] = 0.4 + slope + random.normal(0, 0.004, frame.depth.shape)
    frame.depth[random.random(frame.depth.shape) < 0.2] = 0
    frame.color[:] = random.integers(20, 40, frame.color.shape)


def cover_garbage(frame: RgbdFrame, random: np.random.Generator) -> None:
    """A sensor without a signal: depth anywhere from 0.3 to 4 m, half of it missing."""
    frame.depth[:] = random.uniform(0.3, 4, frame.depth.shape)
    frame.depth[random.random(frame.depth.shape) < 0.5] = 0
    frame.color[:] = random.integers(0, 255, frame.color.shape)


def cover_wall(frame: RgbdFrame, random: np.random.Generator) -> None:
    """Depth of a plane at 1.5 m, which fits many a wall."""
    frame.depth[:] = 1.5 + random.normal(0, 0.005, frame.depth.shape)
    frame.color[:] = 90


COVERS = (cover_near, cover_garbage, cover_wall)


@dataclass(frozen=True)
class Shown:
    """A frame of a trial: which of the data set's, and how it is spoilt."""

    index: int
    change: Change | None = None


@dataclass(frozen=True)
class Trial:
    """A fault after `place` frames of the run and the way back.

    Attributes:
        fault: its name.
        place: rows of the run before it.
        during: frames shown while it lasts; none where the camera is only carried elsewhere.
        back: frames near a place that was seen.
        seed: of what is drawn.
    """

    fault: str
    place: int
    during: tuple[Shown, ...]
    back: tuple[Shown, ...]
    seed: int


@dataclass(frozen=True)
class Outcome:
    """What became of a trial.

    Attributes:
        trial: which.
        flagged_after: frames of the fault until the first lost one, 1 for at once; 0 where no frame was wrong.
        wrong_unflagged: frames whose pose was wrong and not called lost, in all.
        recovered_after: frames of the way back until the first known pose within 3 cm; None where there was none.
        error_cm: distance from where the camera is at the end; infinite where it is lost.
        voxels_added: by mapping frames of the fault whose pose was wrong.
    """

    trial: Trial
    flagged_after: int
    wrong_unflagged: int
    recovered_after: int | None
    error_cm: float
    voxels_added: int

    @property
    def passed(self) -> bool:
        """Flagged within 3 frames, and back within 10."""
        return (
            self.flagged_after <= FLAG_WITHIN
            and self.recovered_after is not None
            and self.recovered_after <= RECOVER_WITHIN
        )


def plan(dataset: RgbdDataset, count: int, seed: int) -> list[Trial]:
    """`count` trials of each fault, at places spread over the run, each coming back somewhere else."""
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


def run_trials(config: Config, dataset: RgbdDataset, trials: list[Trial], device: torch.device) -> Iterator[Outcome]:
    """Runs over every second frame, and from each trial's place on a copy of the system through the trial.

    Raises
    ------
    DatasetError
        When a frame before a fault is called lost, for then there is nothing to compare with, or no truth is known.
    """
    ground_truth = true_poses(dataset)
    system = SlamSystem(config, dataset.camera, ground_truth[0], device)
    with tempfile.TemporaryDirectory() as folder:
        for trial in sorted(trials, key=lambda trial: trial.place):
            while len(system.state.frames) < trial.place:
                if system.process(dataset[STEP * len(system.state.frames)]).lost:
                    raise DatasetError(
                        f"{dataset.name}: frame {len(system.state.frames) - 1} of a clean run is called lost"
                    )
            yield try_fault(copy_of(system, ground_truth[0], Path(folder) / "state"), dataset, trial)


def try_fault(system: SlamSystem, dataset: RgbdDataset, trial: Trial) -> Outcome:
    """One trial on a system that has seen `trial.place` frames; it is used up."""
    random, ground_truth = np.random.default_rng(trial.seed), true_poses(dataset)
    lost, wrong, added = [], [], 0
    for shown in trial.during:
        voxels = system.state.scene.volume.num_voxels
        report = system.process(_spoilt(dataset, shown, random))
        apart_cm, apart_deg = _error(system, ground_truth, trial.place, shown.index)
        lost.append(report.lost)
        wrong.append(shown.change is not None or apart_cm > WRONG_CM or apart_deg > WRONG_DEG)
        added += system.state.scene.volume.num_voxels - voxels if wrong[-1] else 0
    errors = []
    for shown in trial.back:
        report = system.process(_spoilt(dataset, shown, random))
        apart_cm, apart_deg = _error(system, ground_truth, trial.place, shown.index)
        lost.append(report.lost)
        wrong.append(apart_cm > WRONG_CM or apart_deg > WRONG_DEG)
        errors.append(np.inf if report.lost or apart_deg > FOUND_DEG else apart_cm)
    found = [i for i, error in enumerate(errors, 1) if error < FOUND_CM]
    unflagged = [a and not b for a, b in zip(wrong, lost, strict=True)]
    return Outcome(
        trial, _flagged_after(unflagged, wrong), sum(unflagged), found[0] if found else None, errors[-1], added
    )


def _flagged_after(unflagged: list[bool], wrong: list[bool]) -> int:
    """Frames from the first wrong pose up to the first that is called so; 0 if none is wrong."""
    if not any(wrong):
        return 0
    first = wrong.index(True)
    return unflagged.index(False, first) - first + 1 if False in unflagged[first:] else len(wrong)


def _spoilt(dataset: RgbdDataset, shown: Shown, random: np.random.Generator) -> RgbdFrame:
    frame = dataset[shown.index]
    if shown.change is not None:
        shown.change(frame, random)
    return frame


def _error(system: SlamSystem, ground_truth: np.ndarray, place: int, index: int) -> tuple[float, float]:
    """Distance (cm) and angle (degrees) of the last frame's pose from where the map has the camera of a frame."""
    return apart(system.state.frames.matrices(-1)[0], expected_pose(system, ground_truth, place, index))


def expected_pose(system: SlamSystem, ground_truth: np.ndarray, place: int, index: int) -> np.ndarray:
    """Where the map has the camera of a frame: carried by the true motion from the mapped frame that is nearest to it.

    So neither drift of the map nor error of the truth over longer ways takes part.

    Args:
        system: that has seen `place` frames of the run.
        ground_truth: float64 [F, 4, 4] of the data set.
        place: rows of the run.
        index: of the frame in the data set.

    Returns:
        float64 [4, 4] T_world_camera.
    """
    mapped = ground_truth[: STEP * place : STEP]
    turned = rotation_angle(np.swapaxes(mapped[:, :3, :3], 1, 2) @ ground_truth[index, :3, :3])
    nearest = int(np.argmin(np.linalg.norm(mapped[:, :3, 3] - ground_truth[index, :3, 3], axis=1) + turned))
    return system.state.frames.matrices()[nearest] @ inverse(mapped[nearest]) @ ground_truth[index]


def apart(pose: np.ndarray, other: np.ndarray) -> tuple[float, float]:
    """Distance (cm) and angle (degrees) between two poses [4, 4]."""
    angle = rotation_angle(pose[:3, :3].T @ other[:3, :3])
    return 100 * float(np.linalg.norm(pose[:3, 3] - other[:3, 3])), float(np.degrees(angle))


def true_poses(dataset: RgbdDataset) -> np.ndarray:
    """float64 [F, 4, 4]; a `DatasetError` where they are not known."""
    poses = dataset.poses()
    if poses is None:
        raise DatasetError(f"{dataset.name}: must have true poses to try faults on, got none")
    return poses


def copy_of(system: SlamSystem, first_pose: np.ndarray, path: Path) -> SlamSystem:
    """A system with the same state, which goes by way of a file at `path`."""
    write_snapshot(path, take_snapshot(system.state, system.config, {}, copy=False))
    copy = SlamSystem(system.config, system.camera, first_pose, system.device)
    load_checkpoint(path, copy.state, copy.config)
    return copy
