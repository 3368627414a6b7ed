"""`spslam demo`: the whole system on a generated room with known ground truth; nothing to download."""

from __future__ import annotations

import argparse
import shutil
import sys
from dataclasses import replace
from pathlib import Path

from spslam.cli.arguments import add_device, add_quiet, at_least_one, overrides
from spslam.cli.command_name import command_name
from spslam.cli.download import DEFAULT_DATA
from spslam.cli.progress import print_summary
from spslam.cli.run import make_request, run
from spslam.config import load_config
from spslam.download import find_source
from spslam.errors import ConfigError, OutputError
from spslam.run_folder import RunFolder

DEFAULT_OUTPUT = Path("runs/demo")
# A short recording of a desk, named when the demo is done.
FIRST_DOWNLOAD = "tum/fr1_desk"


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--output",
        metavar="DIR",
        type=Path,
        default=DEFAULT_OUTPUT,
        help=f"{DEFAULT_OUTPUT} if not given; an earlier demo there is replaced",
    )
    add_device(parser)
    parser.add_argument("--frames", metavar="N", type=at_least_one, help="only the first N of the 300 frames")
    add_quiet(parser)


def execute(args: argparse.Namespace) -> None:
    config = load_config("demo", overrides=overrides(args))

    from spslam.run.device import resolve_device
    from spslam.run.output_folder import OutputFolder

    resolve_device(config.device)
    with OutputFolder(args.output).locked():  # a demo that is running would lose its files
        _remove_earlier_demo(RunFolder(args.output))
    frames = None if args.frames is None else slice(0, args.frames, 1)
    command = f"{command_name()} run demo" + ("" if frames is None else f" --frames 0:{args.frames}")
    run(replace(make_request(config, args.output, frames), command=args.command_line), args.quiet, command)
    if not args.quiet:
        print("comparing the mesh with the room's exact surface", file=sys.stderr, flush=True)
    metrics = _evaluate(RunFolder(args.output))
    if not args.quiet:
        print_summary(metrics, args.output)
        print(_what_next(args.output))


def _remove_earlier_demo(folder: RunFolder) -> None:
    """Removes the files of an earlier demo, nothing else."""
    if not folder.config.is_file():
        return
    try:
        earlier = load_config(folder.config)
    except ConfigError as error:
        raise OutputError(f"{folder.path}: holds something that isn't a demo; use another --output") from error
    if earlier.dataset.type != "generated":
        raise OutputError(f"{folder.path}: holds a run over other data; use another --output")
    # Temporary files are of a killed run.
    files = {*folder.files(), *folder.path.glob(".*.tmp.*")}
    others = sorted({*folder.path.iterdir()} - files - {folder.previews})
    if others:
        raise OutputError(f"{folder.path}: holds {others[0].name} beside an earlier demo; use another --output")
    for path in files:
        path.unlink(missing_ok=True)
    shutil.rmtree(folder.previews, ignore_errors=True)


def _what_next(output: Path) -> str:
    """The commands that a newcomer would run after the demo."""
    spslam, source = command_name(), find_source(FIRST_DOWNLOAD)
    return f"""
Open {RunFolder(output).report} in a browser. Next, a public recording:
  {spslam} download {source.name}
  {source.run_command(spslam, DEFAULT_DATA)}
or your own, see docs/own-data.md:
  {spslam} run folder --data DIR"""


def _evaluate(folder: RunFolder) -> dict:
    """Adds the mesh's figures, by the room's exact surface, to metrics and report."""
    from spslam.datasets.generated import GeneratedDataset
    from spslam.datasets.registry import open_dataset
    from spslam.evaluation.finished_run import add_metrics, surface_figures, view_figures
    from spslam.evaluation.html_report import write_report
    from spslam.evaluation.run_output import RunOutput

    dataset = open_dataset(load_config(folder.config).dataset)
    finished = RunOutput.read(folder.path)
    if not isinstance(dataset, GeneratedDataset) or finished.mesh() is None:
        return finished.metrics
    figures = surface_figures(finished, dataset, dataset.room) | view_figures(finished, dataset)
    metrics = add_metrics(finished, figures)
    write_report(folder.path)
    return metrics
