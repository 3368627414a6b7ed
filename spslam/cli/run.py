"""``spslam run``: a sequence in, trajectory, map, mesh, metrics and report out."""

from __future__ import annotations

import argparse
import time
from pathlib import Path
from typing import Any

from spslam.cli.arguments import add_config, add_device, add_preset, add_quiet, overrides, parse_frames
from spslam.cli.parser import UsageError
from spslam.cli.progress import make_progress, print_summary
from spslam.config import Config, load_config, resolve_config_path
from spslam.errors import DeviceError
from spslam.run.reader_launch import end_standby, launch_standby


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add_config(parser)
    add_preset(parser)
    parser.add_argument("--output", metavar="DIR", type=Path, help="output folder; runs/CONFIG-TIME if not given")
    add_device(parser)
    parser.add_argument("--frames", metavar="START:STOP[:STEP]", type=parse_frames, help="only these frames")
    parser.add_argument("--seed", metavar="N", type=int, help="seed of all random draws")
    parser.add_argument("--resume", action="store_true", help="go on with the interrupted run in --output")
    parser.add_argument("--no-mesh", action="store_true", help="leave out the mesh")
    add_quiet(parser)


def execute(args: argparse.Namespace) -> None:
    config = load_config(args.config, args.preset, overrides(args))
    if args.resume and args.output is None:
        raise UsageError("--resume needs the interrupted run's folder as --output")
    output = args.output or default_output(args.config)
    metrics = run(config, output, args.frames, args.resume, not args.no_mesh, args.quiet)
    if not args.quiet:
        print_summary(metrics, output)


def run(
    config: Config,
    output: Path,
    frames: slice | None,
    resume: bool,
    mesh: bool,
    quiet: bool,
    command: str = "the same command with",
) -> dict[str, Any]:
    """Run the sequence of a configuration; an interruption says how to go on: by ``command`` and ``--resume``."""
    from spslam.datasets import open_sequence

    data = None if config.dataset.path is None else Path(config.dataset.path)
    # Wrong data is told before torch is loaded.
    open_sequence(config.dataset, data, frames)

    launch_standby(config)
    from spslam.run.sequence import run_sequence

    progress = make_progress(quiet)
    try:
        return run_sequence(config, data, output, frames, resume, mesh, progress)
    except KeyboardInterrupt:
        if _can_go_on(output):
            raise KeyboardInterrupt(f"{command} --output {output} --resume goes on") from None
        raise
    except DeviceError as error:
        if _can_go_on(output):
            raise DeviceError(f"{error}; {command} --output {output} --resume goes on from its checkpoint") from error
        raise
    finally:
        end_standby()
        if progress is not None:
            progress.close()


def _can_go_on(output: Path) -> bool:
    return (output / "checkpoint.safetensors").is_file()


def default_output(config: str) -> Path:
    """``runs/<configuration>-<time>``."""
    return Path("runs") / f"{resolve_config_path(config).stem}-{time.strftime('%Y%m%d-%H%M%S')}"
