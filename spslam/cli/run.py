"""`spslam run`: SLAM over a sequence; writes trajectory, map, mesh, metrics and report."""

from __future__ import annotations

import argparse
import json
import logging
import time
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from spslam.cli.arguments import add_config, add_device, add_preset, add_quiet, choose_config, frame_range, overrides
from spslam.cli.chunks import add_chunks, check_chunks, run_in_chunks
from spslam.cli.parser import UsageError
from spslam.cli.progress import make_progress, print_summary
from spslam.cli.viewing import add_view, opened_viewer
from spslam.config import Config, load_config
from spslam.errors import DeviceError
from spslam.loading import collector_paused
from spslam.run.request import RunRequest
from spslam.run.standby import end_standby, launch_standby
from spslam.run_folder import RunFolder

if TYPE_CHECKING:
    from spslam.run.observer import RunObserver


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add_config(parser)
    add_preset(parser)
    parser.add_argument("--output", metavar="DIR", type=Path, help="output folder; runs/CONFIG-TIME if not given")
    add_device(parser)
    parser.add_argument("--frames", metavar="START:STOP[:STEP]", type=frame_range, help="only these frames")
    parser.add_argument(
        "--map", metavar="OUTPUT", type=Path, help="go on in the map of a finished run: find the camera in it first"
    )
    parser.add_argument("--seed", metavar="N", type=int, help="seed of all random draws")
    parser.add_argument("--resume", action="store_true", help="continue the interrupted run in --output")
    parser.add_argument("--no-mesh", action="store_true", help="leave out the mesh")
    add_view(parser)
    add_chunks(parser)
    add_quiet(parser)


def execute(args: argparse.Namespace) -> None:
    check_chunks(args)
    if args.resume and args.output is None:
        raise UsageError("--resume needs the interrupted run's folder as --output")
    output = args.output or default_output(args.config)
    config = load_config(choose_config(args, args.quiet), args.preset, overrides(args))
    was_finished = args.resume and RunFolder(output).is_finished
    if args.resume and not RunFolder(output).config.exists():
        logging.getLogger("spslam").warning("%s: has no run to be resumed; a new one begins", output)
    request = make_request(config, output, args.frames, args.resume, not args.no_mesh)
    request = replace(request, map=args.map, command=args.command_line)
    if args.chunks is not None:
        metrics = run_in_chunks(request, args)
    else:
        with opened_viewer(args, f"spslam run {args.config}") as viewer:
            metrics = run(request, args.quiet, observer=viewer)
    if not args.quiet:
        if was_finished:
            print("this run had finished before; nothing was left to do")
            if not args.no_mesh and not RunFolder(output).mesh.exists() and RunFolder(output).map.exists():
                print(f"it has no mesh; spslam mesh {output} makes one")
        print_summary(metrics, output)
        if metrics.get("skipped_frames"):
            print(f"skipped first: {_first_skipped(RunFolder(output))}")


def _first_skipped(folder: RunFolder) -> str:
    """Why the first frame that could not be read was left out."""
    with folder.skipped.open(encoding="utf-8") as lines:
        return f"{json.loads(next(lines))['error']}; all are in {folder.skipped}"


def make_request(
    config: Config, output: Path, frames: slice | None, resume: bool = False, mesh: bool = True
) -> RunRequest:
    """The request for a run over the data that the configuration names."""
    data = None if config.dataset.path is None else Path(config.dataset.path)
    return RunRequest(config, data, output, frames, resume, mesh)


def run(
    request: RunRequest, quiet: bool, command: str = "the same command with", observer: RunObserver | None = None
) -> dict[str, Any]:
    """Runs a request with a progress display.

    Args:
        request: what to run.
        quiet: show no progress.
        command: how to run it again; with `--resume` after it, it continues an interrupted run.
        observer: watches the run.

    Returns:
        What is written to metrics.json.

    Raises:
        SpslamError: as of `run_sequence`.
        KeyboardInterrupt: after Ctrl-C; its message says how to resume.
    """
    from spslam.run.data_check import OpenedData

    # Loading torch takes seconds: unusable data are reported before, and a thread looks at the frames meanwhile.
    opened = OpenedData(request)
    launch_standby(request.config, fuses=request.mesh)
    with collector_paused():
        from spslam.run.sequence import run_sequence

    progress = make_progress(quiet)
    resume = f"{command} --output {request.output_dir} --resume continues"
    try:
        return run_sequence(request, progress, observer, opened)
    except KeyboardInterrupt:
        if _can_resume(request.output_dir):
            raise KeyboardInterrupt(resume) from None
        raise
    except DeviceError as error:
        if _can_resume(request.output_dir):
            raise DeviceError(f"{error}; {resume} from its checkpoint") from error
        raise
    finally:
        end_standby()
        if progress is not None:
            progress.close()


def _can_resume(output: Path) -> bool:
    return RunFolder(output).checkpoint.is_file()


def default_output(config: str) -> Path:
    """`runs/<name>-<time>`, the name being that of the configuration or of the recording."""
    return timed_output(Path(config).resolve().stem)


def timed_output(name: str) -> Path:
    """`runs/<name>-<time>`."""
    return Path("runs") / f"{name}-{time.strftime('%Y%m%d-%H%M%S')}"
