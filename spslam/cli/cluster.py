"""Where the runs of a command are executed: processes of this machine, or a Ray cluster."""

from __future__ import annotations

import argparse
import os
import sys
from typing import TYPE_CHECKING

from spslam.cli.arguments import at_least_one
from spslam.cli.parser import UsageError

if TYPE_CHECKING:
    from spslam.tasks.task import Executor


def add_cluster(parser: argparse.ArgumentParser) -> None:
    """`--workers`, `--threads`, `--cluster` and `--copy-data`."""
    parser.add_argument(
        "--workers", metavar="N", type=at_least_one, help="parallel runs (default: one per GPU, or one)"
    )
    parser.add_argument("--threads", metavar="N", type=at_least_one, help="CPU threads per run")
    parser.add_argument(
        "--cluster",
        metavar="ADDRESS",
        help="run on a Ray cluster: HOST:PORT, auto for the one running on this machine, local to start one here alone",
    )
    parser.add_argument(
        "--copy-data",
        action="store_true",
        help="with --cluster, copy the data to each node's disk once, even where its path is there",
    )


def check_cluster(args: argparse.Namespace) -> None:
    """Raises UsageError for `--copy-data` without a cluster."""
    if args.copy_data and args.cluster is None:
        raise UsageError("--copy-data needs --cluster")


def open_executor(args: argparse.Namespace, device: str, cores: int | None = None) -> tuple[Executor, str]:
    """The executor that the arguments choose, not entered yet, and the device of its runs, `cpu` or `cuda`.

    Args:
        args: with `add_cluster`'s.
        device: `auto`, `cpu` or `cuda`; `auto` takes the GPUs of the machine or the cluster if there are any.
        cores: of each run without GPU where the arguments do not say; None for all of a machine.

    Raises:
        ClusterError: there is no such cluster.
        DeviceError: there is no such device on this machine, where the runs would be executed.
    """
    if args.cluster is None:
        from spslam.run.device import resolve_device
        from spslam.tasks.local import LocalExecutor

        found = resolve_device(device).type
        workers = args.workers
        if cores is not None and found == "cpu":
            workers = workers or max((os.cpu_count() or 1) // (args.threads or cores), 1)
        return LocalExecutor(workers, args.threads, found == "cuda"), found
    from spslam.tasks.ray_cluster import RayExecutor, RayOptions

    executor = RayExecutor(RayOptions(args.cluster, args.workers, args.threads, args.copy_data, cores, _notify))
    return executor, ("cuda" if executor.has_gpus else "cpu") if device == "auto" else device


def _notify(line: str) -> None:
    print(f"spslam: {line}", file=sys.stderr, flush=True)
