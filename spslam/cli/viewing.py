"""The options by which commands open a viewer, and what they print about it."""

from __future__ import annotations

import argparse
import contextlib
import os
import socket
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from spslam.cli.parser import UsageError

if TYPE_CHECKING:
    from spslam.viewer.run_viewer import RunViewer

_MAX_PORT = 65535


def add_view(parser: argparse.ArgumentParser) -> None:
    """`--view`, `--rerun` and where the viewer listens, for a command that runs SLAM."""
    parser.add_argument("--view", action="store_true", help="show the run in a browser while it goes on")
    add_address(parser)
    parser.add_argument("--rerun", metavar="FILE.rrd", type=Path, help="record the run for the rerun viewer")


def add_address(parser: argparse.ArgumentParser) -> None:
    """`--host` and `--port`."""
    parser.add_argument(
        "--host", metavar="ADDRESS", help="the viewer listens here, 127.0.0.1 if not given; others ask for a token"
    )
    parser.add_argument(
        "--port", metavar="N", type=port, help="the viewer's port, 8080 if not given; 0 takes a free one"
    )


def port(text: str) -> int:
    """The number of a port."""
    if not text.isdecimal() or not text.isascii() or int(text) > _MAX_PORT:
        raise argparse.ArgumentTypeError(f"must be a port from 0 to {_MAX_PORT}, got {text!r}")
    return int(text)


@contextlib.contextmanager
def opened_viewer(args: argparse.Namespace, title: str) -> Iterator[RunViewer | None]:
    """The viewer that the options of `add_view` ask for, and its address on stderr; None where they ask for none.

    Raises:
        SpslamError: it can't be opened.
    """
    if not args.view and args.rerun is None:
        if args.host is not None or args.port is not None:
            raise UsageError("--host and --port are where a viewer listens; they need --view")
        yield None
        return
    if args.rerun is not None:
        _check_recording(args.rerun)

    from spslam.viewer.options import DEFAULT_HOST, DEFAULT_PORT, ViewerOptions
    from spslam.viewer.run_viewer import open_viewer

    port_number = DEFAULT_PORT if args.port is None else args.port
    options = ViewerOptions(args.view, args.host or DEFAULT_HOST, port_number, args.rerun)
    with open_viewer(options, title, warn) as viewer:
        if viewer.url is not None:
            announce(viewer.url, viewer.has_token, getattr(args, "quiet", False))
        yield viewer


def announce(url: str, has_token: bool, quiet: bool = False) -> None:
    """Prints a viewer's address; where it can't be known otherwise, also if quiet."""
    if quiet and not has_token:
        return
    print(f"viewer: {url}", file=sys.stderr, flush=True)
    if has_token:
        warn(
            "the viewer can be reached from other machines, unencrypted; who has this address can see and pause the run"
        )
    elif "SSH_CONNECTION" in os.environ:
        number = url.rstrip("/").rsplit(":", 1)[-1]
        command = f"ssh -N -L {number}:127.0.0.1:{number} {socket.gethostname()}"
        print(f"from your own computer: {command}, then open it there", file=sys.stderr, flush=True)


def warn(text: str) -> None:
    """One line on stderr, on a line of its own where a progress bar is drawn."""
    start = "\r\033[K" if sys.stderr.isatty() else ""
    print(f"{start}spslam: {text}", file=sys.stderr, flush=True)


def _check_recording(path: Path) -> None:
    if path.suffix != ".rrd":
        raise UsageError(f"--rerun: {path} must end with .rrd")
    if not path.parent.is_dir():
        raise UsageError(f"--rerun: {path.parent} is no folder")
    if path.is_dir():
        raise UsageError(f"--rerun: {path} is a folder")
