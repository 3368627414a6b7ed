"""The report's charts: the trajectory from above, its error, times and tracking measures over the frames."""

from __future__ import annotations

import numpy as np

from spslam.evaluation import charts, report_images
from spslam.evaluation.html_parts import section
from spslam.evaluation.run_output import RunOutput
from spslam.evaluation.trajectory_metrics import align
from spslam.evaluation.verdict import number, path_length_m

_AXES = ("right", "forward", "up")
_LONGEST_BRIDGE = 10  # frames, a third of a second


def aligned_positions(run: RunOutput) -> tuple[np.ndarray, np.ndarray | None]:
    """Estimated positions [F, 3], and ground-truth positions aligned with them; None without ground truth."""
    estimate = run.trajectory.poses[:, :3, 3]
    if run.ground_truth is None or run.known_ground_truth is None:
        return estimate, None
    alignment = align(run.trajectory.poses, run.known_ground_truth)
    return estimate, (run.ground_truth[:, :3, 3] - alignment.translation) @ alignment.rotation


def drawn_ground_truth(ground_truth: np.ndarray) -> np.ndarray:
    """Ground-truth positions [F, 3] for drawing: gaps of a few frames, as where it is recorded less often, are bridged.

    Args:
        ground_truth: [F, 3], NaN where unknown.
    """
    known = np.flatnonzero(np.isfinite(ground_truth).all(axis=1))
    if not len(known):
        return ground_truth
    frames = np.arange(len(ground_truth))
    after = np.searchsorted(known, frames).clip(max=len(known) - 1)
    before = (after - (known[after] > frames)).clip(min=0)
    inside = (frames >= known[0]) & (frames <= known[-1]) & (known[after] - known[before] <= _LONGEST_BRIDGE)
    filled = np.stack([np.interp(frames, known, column[known]) for column in ground_truth.T], axis=1)
    return np.where(inside[:, None], filled, np.nan)


def trajectory_section(run: RunOutput, view: str) -> str:
    """The trajectory from above.

    Args:
        run: the run.
        view: HTML above the chart.
    """
    if not len(run.trajectory):
        return ""
    estimate, ground_truth = aligned_positions(run)
    # Top view in the world frame of the estimate, to which the ground truth is aligned.
    axes = report_images.top_axes(run.trajectory.poses)
    origin = estimate[0]
    top_ground_truth = None if ground_truth is None else (drawn_ground_truth(ground_truth) - origin) @ axes
    chart = charts.trajectory_chart((estimate - origin) @ axes, top_ground_truth, run.trajectory.lost)
    return section("Trajectory", view + chart, f"top view; {path_length_m(run):.2f} m long")


def error_section(run: RunOutput) -> str:
    """The distance from the ground truth over the frames; empty without ground truth."""
    estimate, ground_truth = aligned_positions(run) if len(run.trajectory) else (np.zeros((0, 3)), None)
    if ground_truth is None:
        return ""
    estimate = np.where(run.trajectory.lost[:, None], np.nan, estimate)
    axes = report_images.top_axes(run.trajectory.poses)
    up = np.cross(axes[:, 0], axes[:, 1])
    difference = 100 * (estimate - ground_truth) @ np.column_stack([axes, up])
    series = [charts.Series(name, name[0], column) for name, column in zip(_AXES, difference.T, strict=True)]
    series.append(charts.Series("distance", "total", np.linalg.norm(difference, axis=1)))
    chart = charts.line_chart(series, "cm", run.trajectory.lost)
    return section("Error over time", chart, "position error after rigid alignment, along the axes of the first camera")


def time_section(run: RunOutput) -> str:
    """The time of each stage; empty without a log."""
    if not run.log:
        return ""
    tracking, encoding, mapping = (_column(run, key) / 1000 for key in ("tracking_ms", "encode_ms", "mapping_ms"))
    spent = float(np.nansum(tracking) + np.nansum(encoding) + np.nansum(mapping))
    known = {key: np.nan_to_num(number(run.metrics.get(key))) for key in ("wall_s", "mesh_s", "decode_ms")}
    bar = charts.stacked_bar(
        [
            ("tracking", "tracking", float(np.nansum(tracking))),
            ("encoding and fusion", "encoding", float(np.nansum(encoding))),
            ("mapping", "mapping", float(np.nansum(mapping))),
            ("reading and other work", "rest", max(float(known["wall_s"]) - spent, 0.0)),
            ("mesh", "mesh", float(known["mesh_s"])),
        ],
        "s",
    )
    mapped = encoding + mapping
    mapped[mapped == 0] = np.nan
    tracking[tracking == 0] = np.nan
    # The first frame is mapped much longer, and would set the scale of the chart.
    mapped[0] = np.nan
    series = [
        charts.Series("tracking, per frame", "tracking", 1000 * tracking),
        charts.Series("mapping, per mapped frame", "mapping", 1000 * mapped, dots=True),
    ]
    note = f"images are decoded ahead on other threads, {known['decode_ms']:.1f} ms/frame"
    first_s = number(run.metrics.get("first_mapping_s"))
    first = f"the first mapping took {first_s:.2f} s and is not shown; " if np.isfinite(first_s) else ""
    return section("Time", bar + charts.line_chart(series, "ms", _lost(run)), first + note)


def tracking_section(run: RunOutput) -> str:
    """How well the poses fit; empty without a log of it."""
    residual, inlier_share = _column(run, "residual_cm"), 100 * _column(run, "inlier_share")
    if not np.isfinite(residual).any():
        return ""
    body = charts.line_chart([charts.Series("residual", "tracking", residual)], "cm", _lost(run))
    shares = [charts.Series("pixels on mapped surface", "encoding", inlier_share)]
    depth = 100 * _column(run, "valid_depth_share")
    shares += [charts.Series("pixels with depth", "rest", depth)] if np.isfinite(depth).any() else []
    body += charts.line_chart(shares, "%", _lost(run))
    probability = 100 * _column(run, "error_probability")
    body += charts.line_chart([charts.Series("probability that the pose is wrong", "lost", probability)], "%")
    return section("Tracking", body, "mean distance between the depth image and the map, and how much of it is mapped")


def _lost(run: RunOutput) -> np.ndarray | None:
    """Which frames of the log are lost; None if it is of other frames than the trajectory."""
    return run.trajectory.lost if len(run.trajectory) == len(run.log) else None


def _column(run: RunOutput, key: str) -> np.ndarray:
    """A number of all frames of the log, NaN where it has none."""
    return np.array([number(entry.get(key)) for entry in run.log])
