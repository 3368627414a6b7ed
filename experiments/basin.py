"""Convergence basin: the share of perturbed start poses from which tracking converges, without and with recovery.

    python -m experiments.basin 7scenes path/to/redkitchen --frames 200 --every 10 --trials 10
    python -m experiments.basin 7scenes path/to/redkitchen --frames 200 --every 10 --trials 10 --jumps

Each `--every`-th frame of a run is tracked again, before it is mapped, from starts that are off by fixed distances and
angles in random directions. A start has converged if its pose is within 1 cm and 0.5 degrees of the pose that the run's
own start leads to.

With `--jumps` the camera itself has moved: after each `--every`-th frame, frames of the whole recording are shown as
the next one, up to `--trials` of those that the camera took from 15 to 45 cm and 15 to 45 degrees away (`--least`,
`--most`) and that share at least 30 % of its surface. They are found if their pose is within 3 cm and 3 degrees of the
true motion from the nearest frame that was mapped, lost if they are declared so, and wrong if they are more than 8 cm
or 6 degrees off and are not.
"""

import argparse
import json
from pathlib import Path

import numpy as np
import torch

from experiments.arguments import add_changes, make_parser
from experiments.fault_injection import FOUND_CM, FOUND_DEG, WRONG_CM, WRONG_DEG, apart, expected_pose, gt_poses
from spslam import ops
from spslam.benchmark.environment import describe_environment
from spslam.camera import Camera
from spslam.config import load_config
from spslam.datasets import open_dataset
from spslam.datasets.base import RgbdDataset, Subset
from spslam.geometry import inverse, pose7_to_matrix, rotation_angle
from spslam.slam.pixels import sample_frame
from spslam.slam.poses import pose_tensor
from spslam.slam.system import SlamSystem
from spslam.slam.tracker import TrackingProblem

OFFSETS = ((2, 2), (5, 5), (10, 10), (30, 30))  # cm, degrees
BACK_M, BACK_RAD = 0.01, np.radians(0.5)
COVISIBLE = 0.3  # share of a frame's surface that the other sees, of a jump
ON_SURFACE = 0.05  # of the depth; a point that differs less is seen


def main() -> None:
    parser = make_parser(__doc__)
    parser.add_argument("config")
    parser.add_argument("data", nargs="?", type=Path)
    parser.add_argument("--frames", type=int, default=200, help="frames of the run")
    parser.add_argument("--stride", type=int, default=1, help="use every n-th frame")
    parser.add_argument("--every", type=int, default=10, help="try every n-th of them")
    parser.add_argument("--trials", type=int, default=10, help="starts of each offset at each frame")
    parser.add_argument("--device", default="cpu", help="cpu or cuda")
    parser.add_argument("--jumps", action="store_true", help="move the camera instead of its start")
    parser.add_argument("--least", type=float, default=15, help="of a jump, cm and degrees")
    parser.add_argument("--most", type=float, default=45, help="of a jump, cm and degrees")
    add_changes(parser)
    parser.add_argument("--json", type=Path, help="file to write the shares to")
    args = parser.parse_args()
    rows = jumps(args) if args.jumps else starts(args)
    for row in rows:
        print(*(f"{name} {value:.3g}" for name, value in row.items()), sep="  ")
    if args.json:
        args.json.write_text(
            json.dumps({**describe_environment(torch.device(args.device)), "rows": rows}, indent=1) + "\n"
        )


def starts(args: argparse.Namespace) -> list[dict]:
    """A row of shares for each offset."""
    came_back = measure(args)
    return [
        {"offset_cm": cm, "offset_deg": deg, **{name: float(np.mean(v)) for name, v in came_back[cm, deg].items()}}
        for cm, deg in OFFSETS
    ]


def jumps(args: argparse.Namespace) -> list[dict]:
    """A row: how many jumps there were, and which share of them was found, lost and wrong."""
    config, device = load_config(args.config, None, args.set), torch.device(args.device)
    dataset = open_dataset(config.dataset, args.data)
    ground_truth = gt_poses(dataset)
    system = SlamSystem(config, dataset.camera, ground_truth[0], device)
    random, outcomes = np.random.default_rng(0), []
    for i in range(min(args.frames, (len(dataset) - 1) // args.stride + 1)):
        frame = dataset[i * args.stride]
        if system.process(frame).lost or i == 0 or i % args.every:
            continue
        for index in jumped(dataset, ground_truth, i * args.stride, args, random):
            pixels = sample_frame(dataset[index], dataset.camera, config).to(device)
            found = system.localize(pixels, system.tracker.predict(system.state.frames), i + 1)
            true = expected_pose(system, ground_truth, i + 1, index, args.stride)
            cm, deg = apart(matrix(found.pose), true)
            is_wrong = cm > WRONG_CM or deg > WRONG_DEG
            known = not found.lost
            outcomes.append((known and cm < FOUND_CM and deg < FOUND_DEG, found.lost, known and is_wrong))
            if found.lost or is_wrong:
                state = "lost" if found.lost else f"wrong by {cm:.0f} cm and {deg:.0f} degrees"
                print(f"from {i * args.stride} to {index}: {state}, error probability {found.error_probability:.3f}")
    found, lost, wrong = np.mean(outcomes, axis=0) if outcomes else (np.nan,) * 3
    return [{"jumps": len(outcomes), "found": float(found), "lost": float(lost), "wrong": float(wrong)}]


def jumped(
    dataset: RgbdDataset, ground_truth: np.ndarray, here: int, args: argparse.Namespace, random: np.random.Generator
) -> list[int]:
    """Frames at the wanted distance from frame `here` that share surface with it, at most `--trials`."""
    cm, deg = np.array([apart(pose, ground_truth[here]) for pose in ground_truth]).T
    wanted = (cm > args.least) & (cm < args.most) & (deg > args.least) & (deg < args.most)
    chosen: list[int] = []
    frame = dataset[here]
    for index in random.permutation(np.flatnonzero(wanted)).tolist():
        if len(chosen) == args.trials:
            break
        relative = inverse(ground_truth[here]) @ ground_truth[index]
        if seen_share(dataset[index].depth, frame.depth, relative, dataset.camera) >= COVISIBLE:
            chosen.append(index)
    return chosen


def seen_share(depth: np.ndarray, other: np.ndarray, relative: np.ndarray, camera: Camera) -> float:
    """Share of a depth image's surface [H, W] that another sees, with T_other_this float64 [4, 4]."""
    rows, columns = (8 * np.indices(depth[::8, ::8].shape)).reshape(2, -1)
    z = depth[rows, columns]
    rows, columns, z = rows[z > 0], columns[z > 0], z[z > 0]
    local = np.stack([(columns - camera.cx) / camera.fx * z, (rows - camera.cy) / camera.fy * z, z], 1)
    x, y, z = relative[:3, :3] @ local.T + relative[:3, 3:]
    front = z > ON_SURFACE
    u = np.where(front, x / np.where(front, z, 1) * camera.fx + camera.cx, -1).round().astype(int)
    v = np.where(front, y / np.where(front, z, 1) * camera.fy + camera.cy, -1).round().astype(int)
    inside = front & (u >= 0) & (v >= 0) & (u < depth.shape[1]) & (v < depth.shape[0])
    seen = np.abs(other[v[inside], u[inside]] - z[inside]) < ON_SURFACE * z[inside]
    return float(seen.sum() / max(len(z), 1))


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
