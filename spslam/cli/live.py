"""`spslam live`: SLAM on frames as they come, from a camera or a recording played back."""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from spslam.cli.arguments import (
    add_changes,
    add_config,
    add_device,
    add_preset,
    add_quiet,
    at_least_one,
    choose_config,
    frame_range,
    overrides,
    positive_hertz,
    positive_seconds,
)
from spslam.cli.live_progress import make_live_progress
from spslam.cli.parser import UsageError
from spslam.cli.progress import print_summary
from spslam.cli.run import default_output, timed_output
from spslam.cli.viewing import add_view, opened_viewer
from spslam.config import Config, load_config
from spslam.run.standby import end_standby, launch_standby

REALSENSE_CONFIG = "folder"  # what `--record` writes can be run with the saved configuration
MAX_WAIT_MS = 60.0


def add_arguments(parser: argparse.ArgumentParser) -> None:
    sources = parser.add_subparsers(dest="source", metavar="SOURCE", required=True)
    replay = sources.add_parser("replay", help="a recording at its own pace; frames are dropped when late")
    add_config(replay)
    replay.add_argument("--frames", metavar="START:STOP[:STEP]", type=frame_range, help="only these frames")
    replay.add_argument("--rate", metavar="HZ", type=positive_hertz, help="frames per second; the recording's own")
    replay.add_argument(
        "--repeat", metavar="N", type=at_least_one, default=1, help="play it N times, every second time backward"
    )
    realsense = sources.add_parser("realsense", help="a RealSense depth camera (pip install 'spslam[realsense]')")
    realsense.add_argument(
        "--config", default=REALSENSE_CONFIG, help=f"configuration of the options, {REALSENSE_CONFIG} if not given"
    )
    add_changes(realsense)
    realsense.add_argument("--serial", metavar="NUMBER", help="the camera's serial number, if there are several")
    realsense.add_argument("--size", metavar="WxH", type=_size, help="of both images; 640x480 if not given")
    realsense.add_argument("--rate", metavar="HZ", type=at_least_one, help="frames per second; 30 if not given")
    realsense.add_argument(
        "--recording", metavar="FILE", type=Path, help="a .bag or .db3 of the SDK at its own pace, instead of a camera"
    )
    for source in (replay, realsense):
        _add_common(source)


def _add_common(parser: argparse.ArgumentParser) -> None:
    add_preset(parser)
    parser.add_argument("--output", metavar="DIR", type=Path, help="output folder; runs/SOURCE-TIME if not given")
    parser.add_argument("--record", metavar="DIR", type=Path, help="write the input there, for `spslam run folder`")
    add_device(parser)
    parser.add_argument("--seed", metavar="N", type=int, help="seed of all random draws")
    parser.add_argument("--seconds", metavar="S", type=positive_seconds, help="end after so long; else with Ctrl-C")
    parser.add_argument(
        "--max-wait",
        metavar="MS",
        type=_milliseconds,
        default=MAX_WAIT_MS,
        help=f"drop a frame that waited longer if a newer one is there; {MAX_WAIT_MS:g} if not given",
    )
    parser.add_argument("--no-mesh", action="store_true", help="leave out the mesh")
    add_view(parser)
    add_quiet(parser)


def execute(args: argparse.Namespace) -> None:
    name = choose_config(args, args.quiet) if args.source == "replay" else args.config
    config = load_config(name, args.preset, overrides(args))
    if args.source == "realsense" and args.recording is not None and (args.serial or args.size or args.rate):
        raise UsageError(
            "--recording has the sizes and rate it was recorded with; leave out --serial, --size and --rate"
        )
    output = args.output or (default_output(args.config) if args.source == "replay" else timed_output(args.source))
    launch_standby(config, reads=False)
    try:
        metrics = _run_replay(args, config, output) if args.source == "replay" else _run_realsense(args, config, output)
    finally:
        end_standby()
    if not args.quiet:
        print_summary(metrics, output)


def _run_replay(args: argparse.Namespace, config: Config, output: Path) -> dict[str, Any]:
    from spslam.datasets import open_sequence

    # Report unusable data before torch is loaded, which takes seconds.
    data = None if config.dataset.path is None else Path(config.dataset.path)
    dataset = open_sequence(config.dataset, data, args.frames)

    from spslam.live.replay import ReplaySource

    source = ReplaySource(dataset, args.rate, args.repeat)
    return _run(args, config, output, source, data)


def _run_realsense(args: argparse.Namespace, config: Config, output: Path) -> dict[str, Any]:
    from spslam.live.realsense import RealSenseSource

    width, height = args.size or (None, None)
    with RealSenseSource(args.serial, width, height, args.rate, args.recording) as source:
        return _run(args, config, output, source)


def _run(
    args: argparse.Namespace, config: Config, output: Path, source: Any, data: Path | None = None
) -> dict[str, Any]:
    from spslam.live.request import LiveRequest
    from spslam.live.session import run_live

    if args.record is not None:
        recorded, results = args.record.resolve(), output.resolve()
        if recorded == results:
            raise UsageError(f"--record and --output must be two folders, got {output} for both")
        if recorded in results.parents:
            raise UsageError(f"--output must not be inside the folder of --record, {args.record}, got {output}")
    progress = make_live_progress(args.quiet)
    request = LiveRequest(
        config,
        output,
        record_dir=args.record,
        data_dir=data,
        max_wait_s=args.max_wait / 1e3,
        seconds=args.seconds,
        mesh=not args.no_mesh,
    )
    try:
        with opened_viewer(args, f"spslam live {args.source}") as viewer:
            return run_live(request, source, progress, observer=viewer)
    finally:
        if progress is not None:
            progress.close()


def _size(text: str) -> tuple[int, int]:
    """`WxH` in pixels."""
    parts = text.lower().split("x")
    if len(parts) != 2 or not all(part.isdecimal() and int(part) > 0 for part in parts):
        raise argparse.ArgumentTypeError(f"must be WIDTHxHEIGHT such as 640x480, got {text!r}")
    return int(parts[0]), int(parts[1])


def _milliseconds(text: str) -> float:
    """A time of at least 0."""
    try:
        value = float(text)
    except ValueError:
        value = -1.0
    if not 0 <= value < float("inf"):
        raise argparse.ArgumentTypeError(f"must be a time in milliseconds of at least 0, got {text!r}")
    return value
