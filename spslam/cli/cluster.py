"""Where the runs of a command are executed: processes of this machine, or a Ray cluster."""

from __future__ import annotations

import argparse
import sys
from typing import TYPE_CHECKING, Any

from spslam.cli.arguments import at_least_one
from spslam.cli.parser import UsageError
from spslam.run.chunk_options import CORES

if TYPE_CHECKING:
    from spslam.tasks.task import Executor


# The table of docs/cluster.md is these lines.
OPTIONS: dict[str, dict[str, Any]] = {
    "--workers": {
        "metavar": "N",
        "type": at_least_one,
        "help": "runs at a time; if not given: on this machine one per GPU, without GPU one for a benchmark, whose "
        f"timings others would disturb, and for chunks one per --threads or else {CORES} cores; on a cluster as many "
        "as there is room for. On this machine fewer where there are fewer runs, or not enough memory for as many",
    },
    "--threads": {
        "metavar": "N",
        "type": at_least_one,
        "help": "kernel threads of a run, and the cores that it takes of a cluster's node; if not given: on this "
        "machine an equal share of its cores; on a cluster the cores of its smallest node, divided by its GPUs where "
        f"these are used, but {CORES} at most for chunks without GPU. Results do not depend on it",
    },
    "--cluster": {
        "metavar": "ADDRESS",
        "help": "run on a Ray cluster that this machine belongs to: HOST:PORT, auto for the one that runs on this "
        "machine, local to start one on this machine alone. Without the option no Ray is needed",
    },
    "--copy-data": {
        "action": "store_true",
        "help": "with --cluster, copy recordings to each node's disk once, even where their path is there, as from a "
        "slow network disk",
    },
}


def add_cluster(parser: argparse.ArgumentParser) -> None:
    """`--workers`, `--threads`, `--cluster` and `--copy-data`."""
    for name, argument in OPTIONS.items():
        parser.add_argument(name, **argument)


def check_cluster(args: argparse.Namespace) -> None:
    """Raises UsageError for `--copy-data` without a cluster."""
    if args.copy_data and args.cluster is None:
        raise UsageError("--copy-data needs --cluster")


def open_executor(args: argparse.Namespace, device: str, cores: int | None = None) -> tuple[Executor, str]:
    """The executor that the arguments choose, not entered yet, and the device of its runs, `cpu` or `cuda`.

    Args:
        args: with `add_cluster`'s.
        device: `auto`, `cpu` or `cuda`; `auto` takes the GPUs of the machine or the cluster if there are any.
        cores: of each run without GPU where the arguments do not say; None for all of a machine, one run at a time.

    Raises:
        ClusterError: there is no such cluster.
        DeviceError: there is no such device on this machine, where the runs would be executed.
    """
    if args.cluster is None:
        from spslam.run.device import resolve_device
        from spslam.tasks.local import LocalExecutor

        found = resolve_device(device).type
        notify = _ignore if args.quiet else _notify
        return LocalExecutor(args.workers, args.threads, found == "cuda", cores, notify), found
    from spslam.tasks.ray_cluster import RayExecutor, RayOptions

    executor = RayExecutor(RayOptions(args.cluster, args.workers, args.threads, args.copy_data, cores, _notify))
    return executor, ("cuda" if executor.has_gpus else "cpu") if device == "auto" else device


def _notify(line: str) -> None:
    print(f"spslam: {line}", file=sys.stderr, flush=True)


def _ignore(line: str) -> None:
    """With `--quiet`."""
