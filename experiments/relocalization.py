"""Relocalization: how many poses of a lost camera are accepted, among right ones, wrong ones and those of a wall.

    python -m experiments.relocalization --config 7scenes --data path/to/redkitchen --save kitchen.npz
    python -m experiments.relocalization --saved kitchen.npz room.npz

Every second frame of a sequence is mapped. At four places the camera is interrupted, and frames from the whole sequence
are shown to it one by one, each as the first after the failure: some show mapped surface, others do not. Every third of
them is shown again as a wall of one color, 0.8 to 2.7 m away, that is nowhere in the map. The script prints how many
poses are accepted, at once or if four frames agree, with and without the check of colors, and the reliability diagram:
the error probability stated against the share of poses that are wrong. "With colors" is as where these are registered:
a pose that looks elsewhere is not accepted then. The first command measures one sequence, the
second evaluates saved measurements.
"""

import argparse
import math
import tempfile
from collections.abc import Iterator
from dataclasses import astuple, replace
from pathlib import Path

import numpy as np
import torch

from experiments.arguments import add_measurements, add_options, add_sequence, make_parser
from experiments.basin import matrix
from experiments.fault_injection import (
    STEP,
    WRONG_CM,
    WRONG_DEG,
    apart,
    black_out,
    copy_of,
    cover_wall,
    expected_pose,
    gt_poses,
)
from spslam.cli.arguments import frame_range
from spslam.config import Config, load_config
from spslam.datasets import open_sequence
from spslam.datasets.base import RgbdDataset
from spslam.slam.fit import Fit
from spslam.slam.pixels import sample_frame
from spslam.slam.recovery.pose_confidence import PoseConfidenceModel
from spslam.slam.recovery.recovery import LIKELY_ERROR_PROBABILITY
from spslam.slam.system import SlamSystem

PLACES, FIRST_PLACE = 4, 0.25  # of the sequence
LOST_FRAMES = 6
WALL_EVERY, NEARER_M, FARTHER_M = 3, 0.7, 1.2
QUANTILES = (0.5, 0.9, 0.95, 0.99, 1.0)
RANGES = (0.005, 0.02, 0.1, 0.3, 0.5, 0.7, 0.9)  # of the reliability diagram
# Otherwise the pose of a lost frame would be the start.
KEEPING = ["tracking.lost_threshold=1", "tracking.min_inlier_share=0", "tracking.relocalization_threshold=1"]


def main() -> None:
    """Parses the arguments; measures a sequence, or evaluates saved measurements."""
    args = _parser().parse_args()
    config = load_config(args.config, args.preset, ["device=cpu", *args.set, *KEEPING])
    if args.saved is None:
        dataset = open_sequence(config.dataset, args.data, args.frames)
        table = np.array(list(measure(config, dataset, args.every)))
    else:
        table = np.concatenate([np.load(path)["table"] for path in args.saved])
    if args.save:
        np.savez(args.save, table=table)
    at_once = load_config(args.config, args.preset, args.set).tracking.relocalization_threshold
    judge(table, (at_once, LIKELY_ERROR_PROBABILITY))


def measure(config: Config, dataset: RgbdDataset, every: int) -> Iterator[list[float]]:
    """For each frame shown: whether it is a wall, distance (cm) and angle (degrees) to the true pose, and its fit."""
    ground_truth, random = gt_poses(dataset), np.random.default_rng(0)
    system = SlamSystem(config, dataset.camera, ground_truth[0])
    rows = len(dataset) // STEP
    for place in np.linspace(FIRST_PLACE * rows, rows - 1, PLACES).astype(int).tolist():
        while len(system.state.frames) < place:
            system.process(dataset[STEP * len(system.state.frames)])
        lost = cut_off(system, dataset, ground_truth)
        for number, index in enumerate(range(1, len(dataset), STEP * every)):
            for is_wall in (False, True) if number % WALL_EVERY == 0 else (False,):
                fit, pose = shown(lost, dataset, index, is_wall, random)
                yield [is_wall, *apart(pose, expected_pose(system, ground_truth, place, index)), *astuple(fit)]


def cut_off(system: SlamSystem, dataset: RgbdDataset, ground_truth: np.ndarray) -> SlamSystem:
    """A copy of the system after some black frames."""
    with tempfile.TemporaryDirectory() as folder:
        lost = copy_of(system, ground_truth[0], Path(folder) / "state")
    for _ in range(LOST_FRAMES):
        frame = dataset[0]
        black_out(frame, np.random.default_rng(0))
        lost.process(frame)
    return lost


def shown(
    lost: SlamSystem, dataset: RgbdDataset, index: int, is_wall: bool, random: np.random.Generator
) -> tuple[Fit, np.ndarray]:
    """Fit and pose [4, 4] that the lost system finds for a frame, or for a wall instead; the system is not changed."""
    frame = dataset[index]
    if is_wall:
        cover_wall(frame, random)
        frame.depth[:] += np.float32(random.uniform(-NEARER_M, FARTHER_M))
    pixels = sample_frame(frame, dataset.camera, lost.config)
    frames = lost.state.frames
    start = lost.tracker.predict(frames)
    result = lost.localize(pixels, start, len(frames))
    return result.fit, matrix(result.pose)


def judge(table: np.ndarray, bounds: tuple[float, float]) -> None:
    """Prints how many right poses, wrong poses and poses of walls are accepted, at once and if neighbors agree."""
    wall, is_wrong = table[:, 0] > 0, (table[:, 1] > WRONG_CM) | (table[:, 2] > WRONG_DEG)
    groups = {"right": ~wall & ~is_wrong, "wrong": ~wall & is_wrong, "of a wall": wall}
    fits = [Fit(*line) for line in table[:, 3:].tolist()]
    model = PoseConfidenceModel.load()
    error_probabilities = {
        "with colors": np.array([1.0 if model.looks_elsewhere(fit) else model.error_probability(fit) for fit in fits]),
        "without": np.array([model.error_probability(replace(fit, brightness_correlation=math.nan)) for fit in fits]),
    }
    brightness_correlation = np.array([fit.brightness_correlation for fit in fits])
    for name, group in groups.items():
        known = brightness_correlation[group & np.isfinite(brightness_correlation)]
        span = " to ".join(f"{number:.2f}" for number in (known.min(), known.max())) if len(known) else "unknown"
        print(f"{group.sum()} poses {name}, brightness correlation {span}")
        for how, error_probability in error_probabilities.items():
            if not group.any():
                continue
            shares = ", ".join(f"{(error_probability[group] <= bound).sum()} below {bound:g}" for bound in bounds)
            quantiles = " ".join(f"{value:.3f}" for value in np.quantile(error_probability[group], QUANTILES))
            print(f"  error probability {how:12s} {shares}; quantiles {QUANTILES}: {quantiles}")
    print_reliability(np.array([model.error_probability(fit) for fit in fits]), is_wrong | wall)


def print_reliability(stated: np.ndarray, is_wrong: np.ndarray) -> None:
    """Prints the reliability diagram: how many of the poses with an error probability in a range are wrong."""
    print("| error probability | poses | mean stated | wrong |\n|---|---|---|---|")
    for low, high in zip((0.0, *RANGES), (*RANGES, 1.0), strict=True):
        inside = (stated >= low) & ((stated < high) | (high == 1.0))
        if inside.any():
            frequency, mean = is_wrong[inside].mean(), stated[inside].mean()
            print(f"| {low:g} to {high:g} | {inside.sum()} | {mean:.3f} | {frequency:.3f} |")


def _parser() -> argparse.ArgumentParser:
    parser = make_parser(__doc__)
    add_sequence(parser)
    parser.add_argument("--frames", type=frame_range, help="START:STOP[:STEP]")
    parser.add_argument("--every", type=int, default=3, help="show every n-th of the frames that are not mapped")
    add_options(parser)
    add_measurements(parser)
    return parser


if __name__ == "__main__":
    torch.set_num_threads(1)
    main()
