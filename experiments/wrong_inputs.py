"""Wrong input: what the look at the first frames says of it, and what becomes of the trajectory where it runs.

    python -m experiments.wrong_inputs --place apartment --sensor structured_light --frames 120
    python -m experiments.wrong_inputs --only "focal" --without-poses
    python -m experiments.wrong_inputs --sound --seeds 2        # false alarms: generated places as they are
    python -m experiments.wrong_inputs --sound --late           # with colors 15 ms late and a rolling shutter

Each row is one way in which a recording can be wrong (`experiments/wrong_recordings.py`). The verdict is what `spslam
run` does: `refused`, with what it names, `warned` or `silent`. What is not refused runs: its trajectory is right if
its error (cm, against the true poses) is within 10 % of the worst of three runs of the recording as it is, and no frame
more is lost. A row fails where it is neither refused nor right, and yet the run's own verdict is good.
"""

from __future__ import annotations

import argparse
import itertools
import json
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from experiments.arguments import make_parser
from experiments.wrong_recordings import FAULTS, Fault, WrongRecording
from spslam.config import Config, load_config
from spslam.datasets.base import RgbdDataset
from spslam.datasets.places import MOTIONS, PLACES, SENSORS, Capture, PlacesDataset
from spslam.datasets.plausibility import Finding, check_first_frames
from spslam.errors import DatasetError
from spslam.evaluation.run_output import RunOutput
from spslam.evaluation.trajectory_metrics import ate
from spslam.evaluation.verdict import judge_run
from spslam.run.frame_feed import FrameFeed
from spslam.run_folder import RunFolder
from spslam.slam.system import SlamSystem

WITHIN = 1.1
CLEAN_SEEDS = 3
PLAIN = Capture(color_noise=2)
LATE = replace(PLAIN, exposure_ms=10, rolling_shutter_ms=20, color_delay_ms=15)
DEPTH_RANGE_M = (0.1, 10.0)


def main() -> None:
    """Prints the table, or the false alarms."""
    parser = _parser()
    args = parser.parse_args()
    if args.late and not args.sound:
        parser.error("--late is of --sound")
    rows = _false_alarms(args) if args.sound else _table(args)
    if args.json:
        args.json.write_text(json.dumps(rows, indent=1) + "\n")


def _parser() -> argparse.ArgumentParser:
    parser = make_parser(__doc__)
    parser.add_argument("--place", choices=PLACES, default="apartment")
    parser.add_argument("--motion", choices=MOTIONS, default="handheld")
    parser.add_argument("--sensor", choices=SENSORS, default="structured_light")
    parser.add_argument("--frames", type=int, default=120)
    parser.add_argument("--only", default="", help="faults whose name contains this")
    parser.add_argument("--without-poses", action="store_true", help="the recording comes without ground truth")
    parser.add_argument("--check-only", action="store_true", help="run nothing")
    parser.add_argument("--sound", action="store_true", help="all places, motions and sensors as they are")
    parser.add_argument("--texture", type=float, default=1.0, help="of --sound: contrast of textures, 0 to 1")
    parser.add_argument("--fault", choices=FAULTS, help="of --sound: what is wrong with all of them instead")
    parser.add_argument("--late", action="store_true", help="of --sound: late colors, exposure and rolling shutter")
    parser.add_argument("--seeds", type=int, default=1, help="seeds of --sound")
    parser.add_argument("--first-seed", type=int, default=0, help="the first of them")
    parser.add_argument("--json", type=Path, help="file to write the rows to")
    return parser


def _places(
    place: str, motion: str, sensor: str, frames: int, seed: int = 0, texture: float = 1.0, capture: Capture = PLAIN
) -> PlacesDataset:
    dataset = PlacesDataset(place, motion, sensor, frames, seed, texture, capture)
    dataset.depth_range = DEPTH_RANGE_M
    return dataset


def _table(args: argparse.Namespace) -> list[dict]:
    dataset = _places(args.place, args.motion, args.sensor, args.frames)
    config = load_config("places", overrides=["device=cpu"])
    clean = [(0.0, 0)]
    if not args.check_only:
        sound = WrongRecording(dataset, Fault())
        runs = [_run(config.model_copy(update={"seed": seed}), sound) for seed in range(CLEAN_SEEDS)]
        clean = [_error(system, sound) for system in runs]
    limit, lost = WITHIN * max(error for error, _ in clean), max(count for _, count in clean)
    print(f"{dataset.name}, {args.frames} frames; as it is: {', '.join(f'{error:.2f}' for error, _ in clean)} cm")
    rows = []
    for name, fault in FAULTS.items():
        if args.only in name:
            rows.append(_row(name, WrongRecording(dataset, fault, not args.without_poses), args, config))
            row = rows[-1]
            is_right = (
                row["verdict"] != "refused"
                and row["error_cm"] is not None
                and row["error_cm"] <= limit
                and row["lost"] <= lost
            )
            row["right"], row["passed"] = is_right, is_right or row["run"] != "good"  # "" of what does not run
            figures = "" if row["error_cm"] is None else f"{row['error_cm']:.2f} cm, {row['lost']} lost, {row['run']}"
            print(
                f"{'' if row['passed'] else 'FAILED '}| {name} | {row['verdict']} | {figures} | {row['says']} |",
                flush=True,
            )
    refused = sum(row["verdict"] == "refused" for row in rows)
    right, passed = (sum(row[name] for row in rows) for name in ("right", "passed"))
    print(f"{len(rows)} rows: {refused} refused, {right} right, {len(rows) - passed} wrong without a word")
    return rows


def _row(name: str, recording: WrongRecording, args: argparse.Namespace, config: Config) -> dict:
    began = time.process_time()
    findings = check_first_frames(recording)
    row = {
        "fault": name,
        "seconds": time.process_time() - began,
        **_verdict(findings),
        "error_cm": None,
        "lost": 0,
        "run": "",
    }
    if row["verdict"] != "refused" and not args.check_only:
        system = _run(config, recording)
        row["error_cm"], row["lost"] = _error(system, recording)
        row["run"] = _own_verdict(system, recording, findings)
    return row


def _verdict(findings: list[Finding]) -> dict:
    certain = any(finding.certain for finding in findings)
    verdict = "refused" if certain else "warned" if findings else "silent"
    return {"verdict": verdict, "says": "; ".join(finding.text for finding in findings if finding.certain == certain)}


def _run(config: Config, recording: WrongRecording) -> SlamSystem:
    system = SlamSystem(config, recording.camera)
    with FrameFeed(recording, config, system.device) as feed:
        for item in feed:
            if not isinstance(item, DatasetError):
                system.submit(item).result()
    system.finish()
    return system


def _error(system: SlamSystem, recording: WrongRecording) -> tuple[float, int]:
    """ATE (cm) against the true poses, infinite without a pose, and how many frames are lost or skipped."""
    trajectory, indices = system.trajectory(), system.state.frames.indices.numpy()
    error = ate(trajectory.poses, trajectory.mask_lost(recording.true_poses()[indices]))
    lost = len(recording) - len(indices) + int(trajectory.lost.sum())
    return error.get("ate_rmse_cm", float("inf")), lost


def _own_verdict(system: SlamSystem, recording: WrongRecording, findings: list[Finding]) -> str:
    """What metrics.json would say: by what is found, what is lost, and the poses that the recording claims."""
    trajectory, claimed = system.trajectory(), recording.poses()
    metrics: dict = {"warnings": [str(finding) for finding in findings]}
    if claimed is not None:
        metrics |= ate(trajectory.poses, trajectory.mask_lost(claimed[system.state.frames.indices.numpy()]))
    run = RunOutput(RunFolder(Path()), trajectory, claimed, metrics, [], "", recording.camera)
    return judge_run(run, system.config).level


def _false_alarms(args: argparse.Namespace) -> list[dict]:
    """Findings about places that are as they should be; each is a false alarm."""
    rows = []
    seeds = range(args.first_seed, args.first_seed + args.seeds)
    for place, motion, sensor, seed in itertools.product(PLACES, MOTIONS, SENSORS, seeds):
        capture = LATE if args.late else PLAIN
        dataset: RgbdDataset = _places(place, motion, sensor, 600, seed, args.texture, capture)
        if args.fault is not None:
            dataset = WrongRecording(dataset, FAULTS[args.fault])
        began = time.process_time()
        row = {"name": dataset.name, **_verdict(check_first_frames(dataset)), "seconds": time.process_time() - began}
        rows.append(row)
        if row["verdict"] != "silent":
            print(f"{row['name']}: {row['verdict']}: {row['says']}", flush=True)
    counts = {verdict: sum(row["verdict"] == verdict for row in rows) for verdict in ("refused", "warned", "silent")}
    print(
        f"{len(rows)} recordings: {counts}; {np.median([row['seconds'] for row in rows]):.2f} s of processor time each"
    )
    return rows


if __name__ == "__main__":
    torch.set_num_threads(1)
    main()
