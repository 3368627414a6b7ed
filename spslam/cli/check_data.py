"""`spslam check-data`: shows statistics of a dataset and reports likely problems."""

from __future__ import annotations

import argparse
import math

from spslam.cli.arguments import add_config, choose_config, overrides
from spslam.config import load_config
from spslam.datasets.inspection import Inspection


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add_config(parser)


def execute(args: argparse.Namespace) -> None:
    from spslam.datasets import open_dataset, sequence_options
    from spslam.datasets.inspection import inspect_dataset

    config = load_config(choose_config(args), None, overrides(args))
    for number, options in enumerate(sequence_options(config.dataset)):
        if number:
            print()
        _print(inspect_dataset(open_dataset(options)))


def _print(found: Inspection) -> None:
    for name, text in _rows(found):
        print(f"{name:<14}{text}")
    for problem in found.problems:
        print(f"! {problem}")
    if not found.problems:
        print("no problems found")


def _rows(found: Inspection) -> list[tuple[str, str]]:
    camera = found.camera
    rows = [
        ("data", found.name),
        ("frames", f"{found.frames}{_rate(found.frames_per_second)}; depth of {found.frames_read} checked"),
        ("size", f"{camera.width}x{camera.height} px"),
        ("intrinsics", f"fx {camera.fx:.1f}, fy {camera.fy:.1f}, cx {camera.cx:.1f}, cy {camera.cy:.1f} px"),
    ]
    if found.depth is not None:
        depth = found.depth
        rows.append(("depth", f"{depth.near_m:.2f} to {depth.far_m:.2f} m (1 to 99 %), median {depth.median_m:.2f} m"))
        rows.append(("no depth", f"{depth.holes:.1%} of the pixels, {depth.most_holes:.1%} in the worst frame"))
    if found.focal_error is not None:
        off, sigma = (100 * value for value in found.focal_error)
        rows.append(("focal length", f"{off:+.1f} % +- {sigma:.1f} % off, by how color moves against depth"))
    if found.color_offset is not None:
        mean, spread = (1000 * value for value in found.color_offset)
        rows.append(("color", f"{mean:+.1f} ms +- {spread:.1f} ms after depth, by time stamps"))
    return [*rows, *_pose_rows(found)]


def _rate(frames_per_second: float) -> str:
    """Of one frame, and of times that don't ascend, nothing; of stamps in another unit than seconds, a tiny number."""
    if math.isnan(frames_per_second):
        return ""
    return f", {frames_per_second:.1f} frames/s" if frames_per_second >= 0.05 else f", {frames_per_second:.2g} frames/s"


def _pose_rows(found: Inspection) -> list[tuple[str, str]]:
    poses = found.poses
    if poses is None:
        return [("ground truth", "none")]
    rows = [
        ("ground truth", f"{poses.count} of {found.frames} poses"),
        (
            "motion",
            f"median {poses.step_cm:.2f} cm and {poses.step_deg:.2f} deg per frame, "
            f"maximum {poses.max_step_cm:.1f} cm and {poses.max_step_deg:.1f} deg",
        ),
    ]
    if poses.agreement is not None:
        text = f"{poses.agreement.median_cm:.2f} cm median difference of depth reprojected with ground-truth poses"
        rows.append(("consistency", text))
    return rows
