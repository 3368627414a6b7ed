"""`spslam download`: downloads public datasets from their official URLs."""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path

from spslam.cli.arguments import add_quiet
from spslam.cli.command_name import command_name
from spslam.download import SOURCES, Source, download, find_source, is_complete
from spslam.download.catalog import SCANNET_TERMS

SECONDS_BETWEEN_LINES = 2.0
DEFAULT_DATA = Path("data")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.description = (
        "Download a public dataset from its official URL and unpack it. Without NAME, list the datasets with their "
        "terms of use; by downloading you agree to them. The same command resumes an interrupted download."
    )
    parser.epilog = f"{SCANNET_TERMS}. Any sequence of TUM RGB-D can be given: tum/freiburg1_rpy."
    parser.add_argument(
        "name",
        metavar="NAME",
        nargs="?",
        help="a dataset (replica) or a part of one (7scenes/chess; 7scenes: all parts)",
    )
    parser.add_argument(
        "--data",
        metavar="DIR",
        type=Path,
        default=DEFAULT_DATA,
        help=f"folder to unpack into (default: {DEFAULT_DATA})",
    )
    add_quiet(parser)


def execute(args: argparse.Namespace) -> None:
    if args.name is None:
        _list(args.data)
        return
    parts = [source for source in SOURCES if source.name.startswith(f"{args.name}/")]
    for source in parts or [find_source(args.name)]:
        _download(source, args.data, args.quiet)


def _list(data: Path) -> None:
    for source in SOURCES:
        mark = "  (downloaded)" if is_complete(source, data) else ""
        print(f"{source.name:<20}{source.title}, about {source.gigabytes:g} GB{mark}")
        print(f"{'':<20}{source.terms}")
    print(f"\n{SCANNET_TERMS}")


def _download(source: Source, data: Path, quiet: bool) -> None:
    if not quiet:
        print(f"{source.name}: {source.title}\nterms: {source.terms}", flush=True)
    unpacked = download(source, data, None if quiet else _ProgressLines())
    if not quiet:
        state = "downloaded to" if unpacked else "was already in"
        print(f"{state} {data}; next:\n  {source.run_command(command_name(), data)}")


class _ProgressLines:
    """Prints a line every few seconds: the share of the file downloaded, and the rate."""

    def __init__(self) -> None:
        self._last, self._bytes = time.monotonic(), 0

    def __call__(self, name: str, done: int, total: int | None) -> None:
        now = time.monotonic()
        if done != total and now - self._last < SECONDS_BETWEEN_LINES:
            return
        speed = max(done - self._bytes, 0) / max(now - self._last, 1e-9)
        self._last, self._bytes = now, done
        share = f"{done / total:4.0%} of {total / 1e6:,.0f} MB" if total else f"{done / 1e6:,.0f} MB"
        print(f"{name}: {share}, {speed / 1e6:.1f} MB/s", file=sys.stderr, flush=True)
