"""Convergence basin: the share of perturbed start poses from which tracking converges, without and with recovery.

    python -m experiments.basin 7scenes path/to/redkitchen --frames 200 --every 10 --trials 10

Each `--every`-th frame of a run is tracked again, before it is mapped, from starts that are off by fixed distances and
angles in random directions. A start has converged if its pose is within 1 cm and 0.5 degrees of the pose that the run's
own start leads to.
"""

import argparse
import json
from pathlib import Path

import numpy as np
import torch

from experiments.arguments import add_changes, make_parser
from spslam import ops
from spslam.benchmark.environment import describe_environment
from spslam.config import load_config
from spslam.datasets import open_dataset
from spslam.datasets.base import Subset
from spslam.geometry import pose7_to_matrix, rotation_angle
from spslam.slam.pixels import sample_frame
from spslam.slam.poses import pose_tensor
from spslam.slam.system import SlamSystem
from spslam.slam.tracker import TrackingProblem

OFFSETS = ((2, 2), (5, 5), (10, 10))  # cm, degrees
BACK_M, BACK_RAD = 0.01, np.radians(0.5)


def main() -> None:
    parser = make_parser(__doc__)
    parser.add_argument("config")
    parser.add_argument("data", nargs="?", type=Path)
    parser.add_argument("--frames", type=int, default=200, help="frames of the run")
    parser.add_argument("--stride", type=int, default=1, help="use every n-th frame")
    parser.add_argument("--every", type=int, default=10, help="try every n-th of them")
    parser.add_argument("--trials", type=int, default=10, help="starts of each offset at each frame")
    parser.add_argument("--device", default="cpu", help="cpu or cuda")
    add_changes(parser)
    parser.add_argument("--json", type=Path, help="file to write the shares to")
    args = parser.parse_args()
    came_back = measure(args)
    rows = [
        {"offset_cm": cm, "offset_deg": deg, **{name: float(np.mean(v)) for name, v in came_back[cm, deg].items()}}
        for cm, deg in OFFSETS
    ]
    for row in rows:
        print(*(f"{name} {value:.3g}" for name, value in row.items()), sep="  ")
    if args.json:
        args.json.write_text(
            json.dumps({**describe_environment(torch.device(args.device)), "rows": rows}, indent=1) + "\n"
        )


def measure(args: argparse.Namespace) -> dict[tuple[int, int], dict[str, list[bool]]]:
    """Whether each start converged, by offset and by whether recovery by ICP was allowed."""
    config, device = load_config(args.config, None, args.set), torch.device(args.device)
    dataset = open_dataset(config.dataset, args.data)
    dataset = Subset(dataset, 0, min(args.frames * args.stride, len(dataset)), args.stride)
    ground_truth = dataset.poses()
    system = SlamSystem(config, dataset.camera, None if ground_truth is None else ground_truth[0], device)
    random = np.random.default_rng(0)
    came_back: dict = {offset: {"tracking": [], "with recovery": []} for offset in OFFSETS}
    for i, frame in enumerate(dataset):
        if i and i % args.every == 0:
            pixels = sample_frame(frame, dataset.camera, config).to(device)
            for offset, back in came_back.items():
                for _ in range(args.trials):
                    try_start(system, pixels, i, offset, random, back)
        system.process(frame)
    return came_back


def try_start(system: SlamSystem, pixels, number: int, offset: tuple[int, int], random, back: dict) -> None:
    """Appends to `back` whether one random start with that offset converges."""
    tracker, frames, scene = system.tracker, system.state.frames, system.state.scene
    wanted = matrix(tracker.track(TrackingProblem(scene, pixels.records, tracker.predict(frames), number)).pose)
    start = pose_tensor(moved(wanted, offset, random), frames.poses.device)
    alone = system.recovery.judge(tracker.track(TrackingProblem(scene, pixels.records, start, number)))
    with_recovery = system.localize(pixels, start, number)
    for name, tracked in (("tracking", alone), ("with recovery", with_recovery)):
        found = matrix(start if tracked.lost else tracked.pose)
        distance = np.linalg.norm(found[:3, 3] - wanted[:3, 3])
        back[name].append(distance < BACK_M and rotation_angle(found[:3, :3].T @ wanted[:3, :3]) < BACK_RAD)


def moved(pose: np.ndarray, offset: tuple[int, int], random: np.random.Generator) -> np.ndarray:
    """The pose translated (cm) and rotated (degrees) by an offset in random directions."""
    shift, axis = (v / np.linalg.norm(v) for v in random.normal(size=(2, 3)))
    half = np.radians(offset[1]) / 2
    turn = pose7_to_matrix(np.concatenate([[np.cos(half)], np.sin(half) * axis, np.zeros(3)]))
    out = pose.copy()
    out[:3, :3] = turn[:3, :3] @ pose[:3, :3]
    out[:3, 3] += 0.01 * offset[0] * shift
    return out


def matrix(pose: torch.Tensor) -> np.ndarray:
    """float64 [4, 4] of a pose [7]."""
    return pose7_to_matrix(pose.double().cpu().numpy())


if __name__ == "__main__":
    ops.set_num_threads(torch.get_num_threads())
    main()
