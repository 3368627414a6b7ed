"""How exact and how honest poses are, over generated places x sensors x motions x seeds, beside GICP odometry.

    python -m experiments.places_sweep --places room arcade --sensors stereo --motions walking --seeds 7 8 --jobs 2
    python -m experiments.places_sweep --places arcade --sensors structured_light --motions walking --seeds 0 1 2 \
        --frames 1600 --without-gicp --save arcade.json

A pose is wrong where it is more than 5 cm or 2 degrees off against the frames around it: the median over the trusted
ones of the 21 around it of the error of the relative pose. It is confidently wrong if its error probability is below
0.05 as well. All cases can be tracked, so every lost frame is a false loss. A loop is false if the relative pose of its
two frames is off by more than 10 cm or 5 degrees at the end. With --orb-slam3 its errors on the same frames stand
beside, with and without loop closing: over the frames that it knows, and how many it does not.
"""

import argparse
import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from itertools import product
from pathlib import Path

import numpy as np

from experiments.arguments import add_options, make_parser
from spslam.config import load_config
from spslam.datasets import open_dataset
from spslam.datasets.places import MOTIONS, PLACES, SENSORS
from spslam.evaluation.trajectory_metrics import absolute_errors, align
from spslam.geometry import inverse, rotation_angle
from spslam.run_folder import RunFolder
from spslam.trajectory import Trajectory

WRONG_CM, WRONG_DEG = 5.0, 2.0
CONFIDENT = 0.05  # a smaller error probability claims that the pose is right
AROUND = 10  # frames before and after that a pose is compared with


COLUMNS = (
    "place", "sensor", "motion", "seed", "frames", "ATE cm", "GICP cm", "drift %", "lost", "wrong", "confidently wrong",
    "loops", "false loops", "frames/s", "ORB-SLAM3 cm (lost)", "without loops cm (lost)",
)  # fmt: skip
FALSE_LOOP_M, FALSE_LOOP_DEG = 0.1, 5.0


def main() -> None:
    """Parses the arguments; runs the cases, or one of them; prints a row per case and the sums."""
    args = _parser().parse_args()
    if args.only_baseline:
        name, *case = args.only_baseline
        print(json.dumps(BASELINES[name](args, tuple(case))))
        return
    cases = list(product(args.places, args.sensors, args.motions, args.seeds))
    print(f"| {' | '.join(COLUMNS)} |")
    print("|---" * len(COLUMNS) + "|")
    with ThreadPoolExecutor(args.jobs) as pool:
        rows = []
        for row in pool.map(lambda case: measure(args, case), cases):
            rows.append(row)
            print(table_row(row), flush=True)
            if args.save:
                args.save.write_text(json.dumps(rows))
    print(summary(rows))


def measure(args: argparse.Namespace, case: tuple[str, str, str, int]) -> dict:
    """One run, in a process of its own, and its figures."""
    with tempfile.TemporaryDirectory() as folder:
        output = Path(folder) / "run"
        command = [sys.executable, "-m", "spslam", "run", "places", "--output", str(output), "--quiet", "--no-mesh"]
        options = [f"device={args.device}", "run.previews=0", *settings(args, case)]
        command += [word for option in options for word in ("--set", option)]
        command += [] if args.preset is None else ["--preset", args.preset]
        done = subprocess.run(command, env=_environment(), capture_output=True, text=True)
        row = {"case": list(case)}
        if done.returncode:
            return {**row, "error": done.stderr.strip().splitlines()[-1:]}
        row |= judge(args, case, RunFolder(output), done.stdout + done.stderr)
    baselines = ([] if args.without_gicp else ["gicp"]) + (["orb", "orb_without_loops"] if args.orb_slam3 else [])
    for name in baselines:
        command = [sys.executable, "-m", "experiments.places_sweep", *sys.argv[1:], "--only-baseline", name]
        done = subprocess.run([*command, *map(str, case)], env=_environment(), capture_output=True, text=True)
        row |= json.loads(done.stdout) if done.returncode == 0 else {f"{name}_error": done.stderr[-300:]}
    return row


def settings(args: argparse.Namespace, case: tuple[str, str, str, int]) -> list[str]:
    """The case as changes to options."""
    names = ("dataset.place", "dataset.sensor", "dataset.motion", "dataset.seed")
    chosen = [f"{name}={value}" for name, value in zip(names, case, strict=True)]
    return [*chosen, f"dataset.frames={args.frames}", *args.set]


def judge(args: argparse.Namespace, case: tuple[str, str, str, int], run: RunFolder, output: str) -> dict:
    """The figures of a finished run."""
    truth = dataset_of(args, case).poses()
    log = [json.loads(line) for line in run.log.read_text().splitlines()]
    estimated = np.full((len(truth), 4, 4), np.nan)
    trajectory = Trajectory.load_tum(run.trajectory)
    estimated[~trajectory.lost] = trajectory.poses[~trajectory.lost]
    known = np.isfinite(estimated[:, 0, 0])
    distances = absolute_errors(estimated[known], truth[known], align(estimated[known], truth[known]))
    path_m = float(np.linalg.norm(np.diff(truth[:, :3, 3], axis=0), axis=1).sum())
    from_first = inverse(estimated[0]) @ estimated[known][-1]
    drift_m = np.linalg.norm(from_first[:3, 3] - (inverse(truth[0]) @ truth[known][-1])[:3, 3])
    error_cm, error_deg = local_errors(estimated, truth)
    probability = np.array([np.nan if line["error_probability"] is None else line["error_probability"] for line in log])
    wrong = (error_cm > WRONG_CM) | (error_deg > WRONG_DEG)
    return {
        "frames": len(truth),
        "path_m": path_m,
        "ate_cm": 100 * float(np.sqrt(np.mean(distances**2))),
        "drift_percent": 100 * float(drift_m) / path_m,
        "lost": int(trajectory.lost.sum()),
        "wrong": int(wrong.sum()),
        "confidently_wrong": np.flatnonzero(wrong & (probability < CONFIDENT)).tolist(),
        **loop_figures(log, estimated, truth),
        "fps": json.loads(run.metrics.read_text())["fps"],
        "log": [
            {**{name: line[name] for name in MEASURES}, "lost": line["lost"], "p": line["error_probability"]}
            | {"cm": round(float(cm), 3), "deg": round(float(deg), 3)}
            for line, cm, deg in zip(log, error_cm, error_deg, strict=True)
        ]
        if args.measures
        else [],
    }


def loop_figures(log: list[dict], estimated: np.ndarray, truth: np.ndarray) -> dict:
    """How many loops were closed, and those that join what is not one place: the numbers of their frames."""
    loops = {(loop["source"], loop["target"]) for line in log for loop in line["loops"] if loop["accepted"]}
    false = []
    for source, target in sorted(loops):
        found, expected = (inverse(poses[target]) @ poses[source] for poses in (estimated, truth))
        shift = np.linalg.norm(found[:3, 3] - expected[:3, 3])
        turn = np.degrees(rotation_angle(found[:3, :3].T @ expected[:3, :3]))
        if not (shift < FALSE_LOOP_M and turn < FALSE_LOOP_DEG):
            false.append([source, target, round(float(shift), 3), round(float(turn), 2)])
    return {"loops": len(loops), "false_loops": false}


MEASURES = (
    "residual_cm", "mean_robust_weight", "inlier_share", "min_eigenvalue", "prediction_error_cm",
    "prediction_error_deg", "free_space_violation", "brightness_correlation", "feature_inliers", "feature_share",
    "feature_rays", "map_coverage", "valid_depth_share", "recovered", "relocalized",
)  # fmt: skip


def local_errors(estimated: np.ndarray, truth: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Error of each pose [F] in cm and degrees against the frames around it; NaN where it is not known."""
    frames = len(truth)
    errors_cm, errors_deg = np.full((2, frames), np.nan)
    for i in np.flatnonzero(np.isfinite(estimated[:, 0, 0])):
        near = [j for j in range(max(i - AROUND, 0), min(i + AROUND + 1, frames)) if j != i]
        near = [j for j in near if np.isfinite(estimated[j, 0, 0])]
        if near:
            moved = inverse(estimated[near]) @ estimated[i]
            expected = inverse(truth[near]) @ truth[i]
            errors_cm[i] = 100 * np.median(np.linalg.norm(moved[:, :3, 3] - expected[:, :3, 3], axis=1))
            turns = [rotation_angle(a[:3, :3].T @ b[:3, :3]) for a, b in zip(moved, expected, strict=True)]
            errors_deg[i] = np.degrees(np.median(turns))
    return errors_cm, errors_deg


def gicp(args: argparse.Namespace, case: tuple[str, ...]) -> dict:
    """ATE of voxelized GICP odometry over the same frames."""
    from spslam.benchmark.gicp import GicpOdometry
    from spslam.evaluation.trajectory_metrics import ate

    data = dataset_of(args, (case[0], case[1], case[2], int(case[3])))
    truth = data.poses()
    odometry = GicpOdometry(data.camera, truth[0])
    for frame in data:
        odometry.process(frame.depth)
    return {"gicp_cm": ate(np.array(odometry.poses), truth)["ate_rmse_cm"]}


def orb_slam3(args: argparse.Namespace, case: tuple[str, ...], name: str, loop_closing: bool) -> dict:
    """ATE of ORB-SLAM3's final trajectory over the frames that have a pose in it, how many have none, frames/s."""
    from spslam.benchmark.orb_slam3 import OrbSlam3

    data = dataset_of(args, (case[0], case[1], case[2], int(case[3])))
    truth, busy_s = data.poses(), 0.0
    with OrbSlam3(data.camera, 1 / float(np.median(np.diff(data.timestamps()))), loop_closing) as slam:
        for frame in data:
            started = time.perf_counter()
            slam.process(frame)
            busy_s += time.perf_counter() - started
        poses = slam.finish()
    known = [i for i, pose in enumerate(poses) if pose is not None]
    figures = {f"{name}_lost": len(poses) - len(known), f"{name}_fps": len(poses) / busy_s}
    if len(known) < 3:
        return figures
    found = np.array([poses[i] for i in known])
    errors = absolute_errors(found, truth[known], align(found, truth[known]))
    return figures | {f"{name}_cm": 100 * float(np.sqrt(np.mean(errors**2)))}


BASELINES = {
    "gicp": gicp,
    "orb": partial(orb_slam3, name="orb", loop_closing=True),
    "orb_without_loops": partial(orb_slam3, name="orb_without_loops", loop_closing=False),
}


def dataset_of(args: argparse.Namespace, case: tuple[str, str, str, int]):
    """The case's frames."""
    return open_dataset(load_config("places", args.preset, settings(args, case)).dataset)


def table_row(row: dict) -> str:
    """A row of the table."""
    head = "| " + " | ".join(map(str, row["case"])) + " | "
    if "error" in row:
        return head + f"error: {' '.join(row['error'])} |"
    gicp = row.get("gicp_cm")
    figures = [row["frames"], f"{row['ate_cm']:.2f}", "-" if gicp is None else f"{gicp:.2f}"]
    figures += [f"{row['drift_percent']:.2f}", row["lost"], row["wrong"], len(row["confidently_wrong"])]
    figures += [row["loops"], len(row["false_loops"]), f"{row['fps']:.0f}"]
    figures += [
        f"{row[f'{name}_cm']:.2f} ({row[f'{name}_lost']})" if f"{name}_cm" in row else "-"
        for name in ("orb", "orb_without_loops")
    ]
    return head + " | ".join(map(str, figures)) + " |"


def summary(rows: list[dict]) -> str:
    """Sums and medians over the cases."""
    done = [row for row in rows if "error" not in row]
    frames = sum(row["frames"] for row in done)
    ratios = [row["ate_cm"] / row["gicp_cm"] for row in done if row.get("gicp_cm")]
    lines = [f"{len(done)} of {len(rows)} cases, {frames} frames"]
    for name in ("lost", "wrong"):
        lines.append(f"{name}: {sum(row[name] for row in done)}")
    for name in ("confidently_wrong", "false_loops"):
        lines.append(f"{name.replace('_', ' ')}: {sum(len(row[name]) for row in done)}")
    if ratios:
        lines.append(f"ATE against GICP's: median {statistics.median(ratios):.2f}, at most {max(ratios):.2f}")
    if done:
        drifts = [row["drift_percent"] for row in done]
        lines.append(f"drift: median {statistics.median(drifts):.2f} %, at most {max(drifts):.2f} %")
        lines.append(f"ATE: median {statistics.median(row['ate_cm'] for row in done):.2f} cm")
    for name, title in (("orb", "ORB-SLAM3"), ("orb_without_loops", "ORB-SLAM3 without loops")):
        if found := [row[f"{name}_cm"] for row in done if f"{name}_cm" in row]:
            lines.append(f"ATE of {title}: median {statistics.median(found):.2f} cm in {len(found)} cases")
    return "\n".join(lines)


def _environment() -> dict[str, str]:
    return {**os.environ, "OMP_NUM_THREADS": "1", "OMP_WAIT_POLICY": "passive"}


def _parser() -> argparse.ArgumentParser:
    parser = make_parser(__doc__)
    parser.add_argument("--places", nargs="+", choices=tuple(PLACES), default=tuple(PLACES))
    parser.add_argument("--sensors", nargs="+", choices=tuple(SENSORS), default=tuple(SENSORS))
    parser.add_argument("--motions", nargs="+", choices=tuple(MOTIONS), default=tuple(MOTIONS))
    parser.add_argument("--seeds", nargs="+", type=int, default=[0])
    parser.add_argument("--frames", type=int, default=450)
    parser.add_argument("--device", choices=("cpu", "cuda"), default="cpu")
    parser.add_argument("--jobs", type=int, default=2, help="cases at a time")
    parser.add_argument("--without-gicp", action="store_true", help="do not run GICP odometry")
    parser.add_argument("--measures", action="store_true", help="save each frame's measures of its fit too")
    parser.add_argument("--save", type=Path, help="file for the figures, JSON")
    parser.add_argument("--orb-slam3", action="store_true", help="run it too; see docs/results.md for what it needs")
    parser.add_argument("--only-baseline", nargs=5, help=argparse.SUPPRESS)
    add_options(parser)
    return parser


if __name__ == "__main__":
    main()
