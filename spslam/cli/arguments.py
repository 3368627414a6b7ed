"""Arguments that several commands share."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from spslam.config import config_names
from spslam.errors import OutputError
from spslam.options import PRESETS
from spslam.run.request import parse_frames


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
    try:
        value = float(text)
    except ValueError:
        value = 0.0
    if not 0 < value < float("inf"):
        raise argparse.ArgumentTypeError(f"must be a length in meters above 0, got {text!r}")
    return value


def add_config(parser: argparse.ArgumentParser) -> None:
    """CONFIG and what changes it."""
    parser.add_argument(
        "config", metavar="CONFIG", help=f"a configuration file, or a shipped one: {', '.join(config_names())}"
    )
    parser.add_argument("--data", metavar="DIR", type=Path, help="folder of the data")
    parser.add_argument(
        "--set",
        metavar="SECTION.KEY=VALUE",
        dest="changes",
        action="append",
        default=[],
        help="change an option; may be given several times",
    )


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
        changes.append(("dataset.path", str(args.data.resolve())))
    return changes


def require_run_file(path: Path) -> Path:
    """The same path, of a file in a run's output folder (`RunFolder`); raises OutputError where there is none."""
    output = path.parent
    if not output.exists():
        raise OutputError(f"{output}: no such folder")
    if not output.is_dir():
        raise OutputError(f"{output}: must be the output folder of a run, got a file")
    if not path.is_file():
        raise OutputError(f"{output}: must be the output folder of a finished run, but has no {path.name}")
    return path
