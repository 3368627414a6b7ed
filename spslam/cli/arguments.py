"""Arguments that several commands share."""

from __future__ import annotations

import argparse
import os
from pathlib import Path
from typing import Any

from annotated_types import Le

from spslam.cli.parser import UsageError
from spslam.config import config_names
from spslam.errors import OutputError
from spslam.options import PRESETS, MeshOptions
from spslam.run.request import parse_frames
from spslam.run_folder import RunFolder, is_merged


def frame_range(text: str) -> slice:
    """`START:STOP[:STEP]` as a slice, see `parse_frames`."""
    try:
        return parse_frames(text)
    except ValueError as error:
        raise argparse.ArgumentTypeError(str(error)) from None


def at_least_one(text: str) -> int:
    """A whole number from 1."""
    if not text.isdecimal() or int(text) < 1:
        raise argparse.ArgumentTypeError(f"must be a whole number of at least 1, got {text!r}")
    return int(text)


def positive_meters(text: str) -> float:
    """A length above 0."""
    return _positive(text, "a length in meters")


def mesh_resolution(text: str) -> float:
    """A length within the range of the option mesh.resolution_m."""
    value = positive_meters(text)
    for limit in MeshOptions.model_fields["resolution_m"].metadata:
        if isinstance(limit, Le) and isinstance(limit.le, (int, float)) and value > limit.le:
            raise argparse.ArgumentTypeError(f"must be a length of at most {limit.le} m, got {text!r}")
    return value


def positive_seconds(text: str) -> float:
    """A time above 0."""
    return _positive(text, "a time in seconds")


def positive_hertz(text: str) -> float:
    """A rate above 0."""
    return _positive(text, "a rate in Hz")


def _positive(text: str, what: str) -> float:
    try:
        value = float(text)
    except ValueError:
        value = 0.0
    if not 0 < value < float("inf"):
        raise argparse.ArgumentTypeError(f"must be {what} above 0, got {text!r}")
    return value


def add_config(parser: argparse.ArgumentParser) -> None:
    """CONFIG and what changes it."""
    parser.add_argument(
        "config",
        metavar="CONFIG|PATH",
        help="a recording (a folder, a ROS bag, ...), whose format is found out; or a configuration file, or a shipped "
        f"one: {', '.join(config_names())}",
    )
    parser.add_argument("--data", metavar="PATH", type=Path, help="folder or file of the data, with CONFIG")
    add_changes(parser)


def add_changes(parser: argparse.ArgumentParser) -> None:
    """Options that are changed on the command line."""
    parser.add_argument(
        "--set",
        metavar="SECTION.KEY=VALUE",
        dest="changes",
        action="append",
        default=[],
        help="change an option; may be given several times",
    )


def choose_config(args: argparse.Namespace, quiet: bool = False) -> str:
    """The configuration to load; of a recording in its place the one that reads it, with `args.data` set to it.

    Args:
        args: with `config` and `data`, as `add_config` gives them.
        quiet: don't print what a recording was taken for.

    Raises:
        UsageError: a recording and `--data`.
        DatasetError: a path that is of no format known, or none at all.
    """
    path = Path(args.config)
    if not _names_recording(path):
        return args.config
    if args.data is not None:
        raise UsageError(f"--data {args.data} needs a configuration, got the recording {path}")
    from spslam.datasets.identify import identify_recording

    found = identify_recording(path)
    if not quiet:
        print(f"{path}: taken for {found.description}, as with: {found.config} --data {path}", flush=True)
    args.data = path
    return found.config


def _names_recording(path: Path) -> bool:
    """Whether CONFIG is a recording: a folder, or what ends like one. A shipped configuration's name never is."""
    if str(path) in config_names() or path.suffix in (".yaml", ".yml"):
        return False
    # Imported late: OpenCV and others take a while, which --help need not wait for.
    from spslam.datasets.identify import RECORDING_SUFFIXES

    return path.is_dir() or path.suffix.lower() in RECORDING_SUFFIXES


def add_preset(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--preset", choices=PRESETS, help="paper, balanced (the default) or fast")


def add_device(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--device", metavar="auto|cpu|cuda", help="where to run; auto takes the GPU if there is one")


def add_quiet(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--quiet", action="store_true", help="print nothing but errors")


def add_run_folder(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("output", metavar="OUTPUT", type=Path, help="output folder of a finished run")


def overrides(args: argparse.Namespace) -> list[str | tuple[str, Any]]:
    """What the command line changes in the configuration; options of their own win over `--set`."""
    changes: list[str | tuple[str, Any]] = list(getattr(args, "changes", []))
    for option in ("device", "seed"):
        if getattr(args, option, None) is not None:
            changes.append((option, getattr(args, option)))
    if getattr(args, "data", None) is not None:
        changes.append(("dataset.path", os.path.abspath(args.data)))  # a link's own name may tell the camera
    return changes


def require_run_file(path: Path) -> Path:
    """The same path, of a file in a run's output folder (`RunFolder`); raises OutputError where there is none."""
    output = path.parent
    if not output.exists():
        raise OutputError(f"{output}: no such folder")
    if not output.is_dir():
        raise OutputError(f"{output}: must be the output folder of a run, got a file")
    if path == RunFolder(output).trajectory and is_merged(RunFolder(output)):
        raise OutputError(f"{output}: is a merged map, which has no trajectory of its own; give one of the merged runs")
    if not path.is_file():
        raise OutputError(f"{output}: must be the output folder of a finished run, but has no {path.name}")
    return path
