"""`spslam run --chunks N`: a long recording in chunks, on this machine or a cluster."""

from __future__ import annotations

import argparse
import sys
from typing import TYPE_CHECKING, Any

from spslam.cli.arguments import at_least_one
from spslam.cli.cluster import add_cluster, check_cluster, open_executor
from spslam.cli.parser import UsageError
from spslam.run.chunk_options import CORES, OVERLAP, ChunkOptions

if TYPE_CHECKING:
    from spslam.run.request import RunRequest
    from spslam.tasks.task import TaskEnd

_NEED_CHUNKS = ("overlap", "workers", "threads", "cluster", "copy_data")


def add_chunks(parser: argparse.ArgumentParser) -> None:
    """`--chunks`, and where the chunks are run."""
    parser.add_argument(
        "--chunks", metavar="N", type=at_least_one, help="cut the recording into N chunks, run them apart and join them"
    )
    parser.add_argument(
        "--overlap", metavar="FRAMES", type=at_least_one, help=f"frames that two chunks share (default: {OVERLAP})"
    )
    add_cluster(parser)


def check_chunks(args: argparse.Namespace) -> None:
    """Raises UsageError for options that do not go together."""
    if args.chunks is None:
        for name in _NEED_CHUNKS:
            if getattr(args, name):
                raise UsageError(f"--{name.replace('_', '-')} needs --chunks")
        return
    check_cluster(args)
    if args.chunks < 2:
        raise UsageError("--chunks must be 2 at least; without it the recording is run over in one piece")
    if args.map is not None:
        raise UsageError("--chunks makes a new map; go on in another with --map in a run without it, or spslam merge")
    if args.view or any(getattr(args, name) is not None for name in ("rerun", "host", "port")):
        raise UsageError("--view and --rerun show a run in one piece; spslam view OUTPUT shows the joined result")


def run_in_chunks(request: RunRequest, args: argparse.Namespace) -> dict[str, Any]:
    """Runs a request in chunks and joins them; returns what is written to metrics.json.

    Raises:
        SpslamError: as of `run_chunks`.
        KeyboardInterrupt: after Ctrl-C; its message says how to resume.
    """
    from spslam.run.chunks import run_chunks

    executor, device = open_executor(args, request.config.device, CORES)
    options = ChunkOptions(args.chunks, args.overlap or OVERLAP, device)
    try:
        with executor:
            return run_chunks(request, options, executor, None if args.quiet else _print_progress)
    except KeyboardInterrupt:
        raise KeyboardInterrupt(f"the same command with --output {request.output_dir} --resume continues") from None


def _print_progress(done: int, total: int, end: TaskEnd) -> None:
    where = f" on {end.node}" if end.node else ""
    text = f"FAILED: {end.error}" if end.error else f"{end.seconds:.0f} s{where}"
    print(f"[{done}/{total}] {end.key}: {text}", file=sys.stderr, flush=True)
    if done == total and not end.error:
        print("joining the chunks", file=sys.stderr, flush=True)
