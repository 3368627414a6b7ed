"""`spslam bench`: runs a suite of sequences, presets and seeds, and compares the results with the paper."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import Any

from spslam.cli.arguments import add_quiet, at_least_one
from spslam.cli.cluster import add_cluster, check_cluster, open_executor
from spslam.cli.parser import UsageError
from spslam.errors import SpslamError
from spslam.options import PRESETS
from spslam.run.request import parse_frames


def add_arguments(parser: argparse.ArgumentParser) -> None:
    suite = "quick, places, ablation, or a dataset's; --list names all"
    parser.add_argument("suite", metavar="SUITE", nargs="?", help=suite)
    parser.add_argument("--data", metavar="ROOT", type=Path, help="folder that contains the datasets")
    parser.add_argument(
        "--folders",
        metavar="FILE",
        type=Path,
        help="YAML file of folders, SUITE: {SEQUENCE: FOLDER}, if the folders have other names",
    )
    parser.add_argument("--output", metavar="DIR", type=Path, help="folder of results; runs/bench-SUITE if not given")
    parser.add_argument(
        "--device", choices=("auto", "cpu", "cuda"), default="auto", help="auto uses all GPUs if there are any"
    )
    parser.add_argument("--presets", metavar="NAME", nargs="+", choices=PRESETS, help="presets to run")
    parser.add_argument(
        "--seeds", metavar="N", type=at_least_one, help="runs per sequence and preset, with seeds 0 to N-1 (paper: 5)"
    )
    parser.add_argument("--frames", metavar="START:STOP[:STEP]", help="only these frames of every sequence; : for all")
    parser.add_argument("--sequences", metavar="NAME", nargs="+", help="only these sequences")
    parser.add_argument("--studies", metavar="NAME", nargs="+", help="only these studies of the ablation")
    add_cluster(parser)
    parser.add_argument("--no-baseline", action="store_true", help="skip the baselines, ORB-SLAM3 and GICP odometry")
    parser.add_argument("--keep", action="store_true", help="keep trajectory, mesh and report of each run")
    parser.add_argument("--report", metavar="PAGE", type=Path, help="also update the tables in a Markdown page")
    parser.add_argument("--list", action="store_true", help="list the runs without starting them")
    add_quiet(parser)


def execute(args: argparse.Namespace) -> None:
    from spslam.benchmark.suites import load_suite, suite_names

    if args.suite is None:
        if not args.list:
            raise UsageError(f"SUITE must be one of {', '.join(suite_names())}")
        for name in suite_names():
            print(f"{name:<16}{load_suite(name).title}")
        return
    check_cluster(args)
    if args.frames is not None:
        _check_frames(args.frames)
    suite = load_suite(
        args.suite, args.presets, args.sequences, args.studies, args.frames, args.seeds, not args.no_baseline
    )
    if args.folders is not None:
        suite = _in_folders(suite, args)
    _run_suite(suite, args)


def _in_folders(suite: Any, args: argparse.Namespace) -> Any:
    from spslam.benchmark.folders import read_folders, with_folders

    if args.data is None:
        raise UsageError("--folders needs --data, the folder that its folders are in")
    return with_folders(suite, read_folders(args.folders))


def _run_suite(suite: Any, args: argparse.Namespace) -> None:
    from spslam.benchmark.jobs import make_plan
    from spslam.benchmark.records import run_jobs
    from spslam.benchmark.summary import summarize
    from spslam.run.device import resolve_device

    if args.data is not None and not args.data.is_dir():
        raise UsageError(f"--data must be a folder that contains the datasets, got {args.data}")
    if args.list:
        _print_plan(make_plan(suite, args.data, resolve_device(args.device).type))
        return
    output = args.output or Path("runs") / f"bench-{suite.name}"
    executor, device = open_executor(args, args.device)
    with executor:
        plan = make_plan(suite, args.data, device)
        outcomes = run_jobs(plan.jobs, output, executor, args.keep, None if args.quiet else _print_progress)
    summary = summarize(suite, plan, outcomes)
    _write_results(summary, output, args)
    if summary.failed:
        raise SpslamError(f"{len(summary.failed)} of {len(plan.jobs)} runs failed; the first: {summary.failed[0]}")
    if not plan.jobs:
        raise SpslamError(
            f"no run of {suite.name} is possible: no data found; --data names the folder that contains it"
        )


def _write_results(summary: Any, output: Path, args: argparse.Namespace) -> None:
    from spslam.benchmark.suite_report import describe_gaps, update_page, write_results
    from spslam.benchmark.tables import to_text

    tables = write_results(summary, output)
    if not args.quiet:
        for table in tables:
            print(f"{to_text(table)}\n")
        print(f"tables  {output / 'results.md'}, {output / 'results.html'}, {output / 'summary.json'}")
    if args.report is not None:
        filled = update_page(args.report, summary)
        if not args.quiet:
            print(f"page    {args.report}: {', '.join(filled) or 'nothing to fill'}")
    for line in describe_gaps(summary):
        print(line, file=sys.stderr)


def _check_frames(text: str) -> None:
    try:
        parse_frames(text)
    except ValueError as error:
        raise UsageError(f"--frames {error}") from None


def _print_plan(plan: Any) -> None:
    for key, job in plan.jobs.items():
        options = ", ".join(f"{name}={value}" for name, value in (*job.options, *job.method_options))
        print(f"{key}  {job.method} {job.preset or ''} {job.frames or 'all frames'} {options}".rstrip())
    for name, reason in plan.skipped.items():
        print(f"skipped {name}: {reason}")
    print(f"{len(plan.jobs)} runs")


def _print_progress(done: int, total: int, outcome: Any) -> None:
    """Prints a line to stderr for each run that ends; runs from earlier calls are skipped, except the last."""
    if outcome.earlier and done < total:
        return
    record = outcome.record
    if record is None:
        text = f"FAILED: {outcome.error}"
    else:
        figures = record["figures"]
        shown = [f"ATE {figures['ate_rmse_cm']:.2f} cm"] if "ate_rmse_cm" in figures else []
        shown += [f"{figures['fps']:.1f} frames/s", f"{record['seconds']:.0f} s"]
        shown += ["of an earlier call, whose record is in the output folder"] if outcome.earlier else []
        text = ", ".join(shown)
    print(f"[{done}/{total}] {outcome.key}: {text}", file=sys.stderr, flush=True)
