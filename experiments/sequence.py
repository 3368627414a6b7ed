"""Whole runs over a sequence: frames/s, accuracy, time per stage, memory, and whether repeated runs are identical.

    python -m experiments.sequence --config 7scenes --data path/to/redkitchen --frames 0:300 --device cuda \
        --preset balanced --preset paper --repeats 5 --json sequence.json

The runs of a preset follow one another in one process; the table has their medians. Decoding is part of a run,
extracting the mesh is not. Exits with 1 if runs of one preset differ in a byte of trajectory or map:
`--repeats 10 --preset balanced` is the test of determinism.
"""

import argparse
import hashlib
import json
import statistics
import subprocess
import sys
import tempfile
from pathlib import Path

import torch

from experiments import timing
from experiments.arguments import add_changes, add_sequence, make_parser
from spslam.config import load_config
from spslam.options import PRESETS
from spslam.run.device import resolve_device
from spslam.run.request import parse_frames
from spslam.run.sequence import RunRequest, run_sequence
from spslam.run.standby import launch_standby
from spslam.run_folder import RunFolder

# Columns of the table that are medians of metrics.json.
FIGURES = (
    "fps",
    "ate_rmse_cm",
    "lost_frames",
    "wait_ms",
    "tracking_ms",
    "encode_ms",
    "mapping_ms",
    "other_ms",
    "upload_ms",
    "decode_ms",
    "tracking_ms_per_iteration",
    "mapping_ms_per_iteration",
    "first_mapping_s",
    "peak_gpu_mb",
    "peak_rss_mb",
)


def main() -> None:
    """Parses the arguments; runs each preset in its own process, or in this one with `--job`."""
    args = _parser().parse_args()
    if args.job:
        print(json.dumps(run_preset(args, args.job)))
        return
    rows = []
    for preset in args.preset or PRESETS:
        runs = _in_own_process(preset)
        rows.append(summarize(preset, runs))
        print(f"{preset}: " + ", ".join(f"{run['fps']:.1f}" for run in runs) + " frames/s", flush=True)
    title = f"{args.config}, frames {args.frames or 'all'}, {args.repeats} runs per preset, medians"
    timing.report(title, rows, resolve_device(args.device), args.json)
    if any(row["results"] != 1 for row in rows):
        sys.exit("runs with the same seed differ")


def _parser() -> argparse.ArgumentParser:
    parser = make_parser(__doc__)
    add_sequence(parser)
    parser.add_argument("--frames", help="START:STOP[:STEP]")
    parser.add_argument("--device", default="auto")
    parser.add_argument("--preset", action="append", choices=PRESETS, help="all where none is given")
    parser.add_argument("--repeats", type=int, default=3, help="runs of each preset")
    add_changes(parser)
    parser.add_argument("--json", type=Path, help="file to write the results to")
    parser.add_argument("--job", help=argparse.SUPPRESS)
    return parser


def _in_own_process(preset: str) -> list[dict]:
    command = [sys.executable, "-m", "experiments.sequence", *sys.argv[1:], "--job", preset]
    done = subprocess.run(command, stdout=subprocess.PIPE, text=True, check=True)
    return json.loads(done.stdout.splitlines()[-1])


def run_preset(args: argparse.Namespace, preset: str) -> list[dict]:
    """The metrics of each run, with a digest of its trajectory and map."""
    overrides = [f"device={args.device}", "run.previews=0", *args.set]
    config = load_config(args.config, preset, overrides)
    frames = parse_frames(args.frames) if args.frames else None
    runs = []
    for _ in range(args.repeats):
        with tempfile.TemporaryDirectory() as folder:
            output = Path(folder) / "run"
            launch_standby(config)  # as `spslam run` does
            metrics = run_sequence(RunRequest(config, args.data, output, frames, mesh=False))
            runs.append({**metrics, "digest": digest(output)})
    return runs


def digest(output: Path) -> str:
    """Hash of trajectory and map."""
    folder = RunFolder(output)
    content = folder.trajectory.read_bytes() + folder.map.read_bytes()
    return hashlib.sha256(content).hexdigest()[:16]


def summarize(preset: str, runs: list[dict]) -> dict[str, object]:
    """A row of the table: medians, the slowest run, and the number of different results."""
    row: dict[str, object] = {"preset": preset, "results": len({run["digest"] for run in runs})}
    row["fps_least"] = min(run["fps"] for run in runs)
    for name in FIGURES:
        if name in runs[0]:
            row[name] = float(statistics.median(run[name] for run in runs))
    return row


if __name__ == "__main__":
    torch.set_num_threads(1)
    main()
