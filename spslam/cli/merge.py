"""`spslam merge`: joins the maps of finished runs that share a place."""

from __future__ import annotations

import argparse
from pathlib import Path

from spslam.cli.arguments import add_device, add_quiet
from spslam.cli.parser import UsageError
from spslam.cli.run import timed_output
from spslam.run_folder import RunFolder


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "runs", metavar="OUTPUT", nargs="+", type=Path, help="output folders of finished runs; two at least"
    )
    parser.add_argument("--output", metavar="DIR", type=Path, help="output folder; runs/merged-TIME if not given")
    add_device(parser)
    parser.add_argument("--no-mesh", action="store_true", help="leave out the mesh")
    add_quiet(parser)


def execute(args: argparse.Namespace) -> None:
    if len(args.runs) < 2:
        raise UsageError("merge needs the output folders of two finished runs at least")
    output = args.output or timed_output("merged")

    from spslam.run.merge import MergeRequest, merge_runs

    request = MergeRequest(args.runs, output, not args.no_mesh, args.device or "auto", args.command_line)
    metrics = merge_runs(request)
    if args.quiet:
        return
    print(f"{output}: {metrics['keyframes']} keyframes of {len(metrics['recordings'])} recordings in one map")
    folder = RunFolder(output)
    for number, name in enumerate(metrics["recordings"]):
        print(f"{folder.trajectory_of(number)}: {name}")
    if folder.mesh.is_file():
        print(f"{folder.mesh}: {metrics['mesh_source']} at {metrics['mesh_resolution_m']:g} m")
    for warning in metrics.get("warnings", ()):
        print(f"! {warning}")
