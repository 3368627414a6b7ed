"""`spslam import`: copies a recording of any format into a folder of images, cameras, poses and times."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from spslam.cli.arguments import add_config, add_quiet, choose_config, frame_range, overrides
from spslam.config import load_config

# Of the reasons for frames that were left out, so many are listed.
_LISTED = 5


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.description = (
        "Copy a recording of any format into OUT: images of one pinhole camera (distortion undone, color and depth "
        "registered), intrinsics.json, times.txt and, where known, poses.txt. Depth outside dataset.min_depth_m to "
        "dataset.max_depth_m is left out. spslam run folder --data OUT reads it."
    )
    add_config(parser)
    parser.add_argument("output", metavar="OUT", type=Path, help="a new or an empty folder")
    parser.add_argument("--frames", metavar="START:STOP[:STEP]", type=frame_range, help="only these frames")
    add_quiet(parser)


def execute(args: argparse.Namespace) -> None:
    config = load_config(choose_config(args, args.quiet), None, overrides(args))

    from tqdm import tqdm

    from spslam.datasets import import_folder, open_sequence

    dataset = open_sequence(config.dataset, None, args.frames)
    if config.dataset.mask is None:
        dataset.left_out = None  # what moves along with the camera is found in the copy again
    hidden = args.quiet or not sys.stderr.isatty()
    with tqdm(total=len(dataset), unit=" frames", disable=hidden) as bar:
        faults = import_folder(dataset, args.output, lambda done: bar.update(done - bar.n))
    if args.quiet:
        return
    camera = dataset.camera
    print(f"{args.output}: {len(dataset) - len(faults)} frames of {camera.width}x{camera.height}, from {dataset.name}")
    for fault in faults[:_LISTED]:
        print(f"! left out: {fault}")
    if len(faults) > _LISTED:
        print(f"! left out: {len(faults) - _LISTED} more frames")
