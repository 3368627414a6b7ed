"""Fault injection over a sequence: are tracking failures flagged, and is the camera relocalized at mapped places?

    python -m experiments.faults --config 7scenes --data path/to/redkitchen --preset fast --trials 10 --json faults.json

Faults are 30 black frames, a jump over 60 frames, 20 frames of a covered lens, and an immediate return to the start;
each trial returns to another place (`experiments/fault_injection.py`). `--black-outs 1 3 10` tries only black-outs of
these lengths; with `--between 75` the camera then first sees, for so many frames, where it has moved on to, and the
table says how many of these have a pose at the end: in the map, or in one of their own that did not join. Exits
with 1 unless the failure is flagged within 3 frames in every trial, and 9 of 10 trials have a pose within 3 cm within
10 frames after the return.
"""

import argparse
import statistics
import sys
from pathlib import Path

import torch

from experiments import timing
from experiments.arguments import add_options, add_sequence, make_parser
from experiments.fault_injection import FLAG_WITHIN, Outcome, plan, plan_black_outs, run_trials
from spslam.cli.arguments import frame_range
from spslam.config import load_config
from spslam.datasets import open_sequence
from spslam.run.device import resolve_device

RECOVERED_SHARE = 0.9


def main() -> None:
    """Parses the arguments, runs the trials, prints a line per failed trial and a table of all."""
    args = _parser().parse_args()
    device = resolve_device(args.device)
    config = load_config(args.config, args.preset, [f"device={args.device}", *args.set])
    dataset = open_sequence(config.dataset, args.data, args.frames)
    outcomes = []
    trials = plan(dataset, args.trials, args.seed)
    if args.black_outs:
        trials = plan_black_outs(dataset, args.trials, args.seed, args.black_outs, args.between)
    for outcome in run_trials(config, dataset, trials, device):
        outcomes.append(outcome)
        if args.verbose or not outcome.passed:
            print(describe(outcome), flush=True)
    rows = [summarize(fault, outcomes) for fault in sorted({outcome.trial.fault for outcome in outcomes})]
    timing.report(
        f"{dataset.name}, {args.preset or config.preset}, {args.trials} trials per fault", rows, device, args.json
    )
    if not all(row["flagged"] == row["trials"] and row["recovered"] >= RECOVERED_SHARE * row["trials"] for row in rows):
        sys.exit("a required rate is missed")


def _parser() -> argparse.ArgumentParser:
    parser = make_parser(__doc__)
    add_sequence(parser)
    parser.add_argument("--frames", type=frame_range, help="START:STOP[:STEP]")
    parser.add_argument("--device", default="auto")
    parser.add_argument("--trials", type=int, default=10, help="of each fault")
    parser.add_argument("--black-outs", type=float, nargs="+", help="only black-outs, of so many seconds each")
    parser.add_argument("--between", type=int, default=0, help="frames seen between a black-out and the return")
    parser.add_argument("--seed", type=int, default=0, help="of the places to return to and of noise")
    add_options(parser)
    parser.add_argument("--verbose", action="store_true", help="print a line per trial")
    parser.add_argument("--json", type=Path, help="file to write the results to")
    return parser


def describe(outcome: Outcome) -> str:
    """A trial in one line."""
    trial, back = outcome.trial, outcome.recovered_after
    found = "not relocalized" if back is None else f"relocalized after {back}"
    return (
        f"{trial.fault} at {trial.place}, back at frame {trial.back[0].index}: flagged after {outcome.flagged_after}, "
        f"{outcome.wrong_unflagged} wrong poses not flagged, {found}, {outcome.error_cm:.2f} cm at the end, "
        f"{outcome.voxels_added} voxels added, {outcome.kept} and {outcome.kept_apart} of {outcome.seen} frames kept"
    )


def summarize(fault: str, outcomes: list[Outcome]) -> dict[str, object]:
    """A row of the table."""
    of_fault = [outcome for outcome in outcomes if outcome.trial.fault == fault]
    found = [outcome.recovered_after for outcome in of_fault if outcome.recovered_after is not None]
    return {
        "fault": fault,
        "trials": len(of_fault),
        "flagged": sum(outcome.flagged_after <= FLAG_WITHIN for outcome in of_fault),
        "flagged_after_most": max(outcome.flagged_after for outcome in of_fault),
        "wrong_unflagged": sum(outcome.wrong_unflagged for outcome in of_fault),
        "recovered": sum(outcome.passed for outcome in of_fault),
        "recovered_after_median": statistics.median(found) if found else None,
        "recovered_after_most": max(found, default=None),
        "voxels_added": sum(outcome.voxels_added for outcome in of_fault),
        "seen": sum(outcome.seen for outcome in of_fault),
        "kept": sum(outcome.kept for outcome in of_fault),
        "kept_apart": sum(outcome.kept_apart for outcome in of_fault),
    }


if __name__ == "__main__":
    torch.set_num_threads(1)
    main()
