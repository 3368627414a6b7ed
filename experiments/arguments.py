"""Arguments that several scripts share."""

import argparse
from pathlib import Path

from spslam.options import PRESETS


def make_parser(description: str | None) -> argparse.ArgumentParser:
    """A parser that shows a script's docstring as it is."""
    return argparse.ArgumentParser(description=description, formatter_class=argparse.RawDescriptionHelpFormatter)


def add_sequence(parser: argparse.ArgumentParser) -> None:
    """Which data."""
    parser.add_argument("--config", default="demo", help="configuration file or name")
    parser.add_argument("--data", type=Path, help="the sequence's folder")


def add_options(parser: argparse.ArgumentParser) -> None:
    """One preset, and changes to it."""
    parser.add_argument("--preset", choices=PRESETS)
    add_changes(parser)


def add_changes(parser: argparse.ArgumentParser) -> None:
    """Changes to single options."""
    parser.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help="further options")


def add_measurements(parser: argparse.ArgumentParser) -> None:
    """Where measurements are saved, or read from."""
    parser.add_argument("--save", type=Path, help="file for the measurements")
    parser.add_argument("--saved", type=Path, nargs="+", help="files of earlier calls to evaluate together")
