"""Writes report.html, a self-contained page about one run, from the files in its output folder."""

from __future__ import annotations

import html
import os
from pathlib import Path
from typing import Any

import numpy as np

from spslam.camera import Camera
from spslam.evaluation import charts, report_images
from spslam.evaluation.report_style import STYLE
from spslam.evaluation.run_output import Mesh, Preview, RunOutput
from spslam.evaluation.trajectory_metrics import align
from spslam.io import atomic_write
from spslam.meshing.render import render_mesh

VIEWS = 3
# The metrics at the top: label, key in metrics.json, format.
_TILES = (
    ("frames", "frames", "{:,}"),
    ("frames per second", "fps", "{:.1f}"),
    ("ATE RMSE", "ate_rmse_cm", "{:.2f} cm"),
    ("F1 at 5 cm", "f1_5cm", "{:.1f} %"),
    ("lost frames", "lost_frames", "{}"),
    ("tracking", "tracking_fps", "{:.0f} frames/s"),
    ("model", "model_mb", "{:.1f} MB"),
    ("memory", "peak_rss_mb", "{:,.0f} MB"),
)


def write_report(output_dir: str | os.PathLike) -> Path:
    """Writes `report.html` of a finished run.

    The page is self-contained: styles and images are embedded, charts are SVG, there is no script.

    Args:
        output_dir: output folder of the run. `trajectory.txt` and `metrics.json` are required. `mesh.ply`,
            `log.jsonl`, `config.yaml` and `previews/` are optional: without one of them its sections are left out.
            `previews/` has `camera.json`, `ground_truth.txt`, `frame-NNNNNN.png` and `depth-NNNNNN.png` in 16-bit
            millimeters, numbered by row of the trajectory.

    Returns:
        Path of the report.

    Raises:
        OutputError: the folder is not the output folder of a finished run, a file in it is damaged, or the report
            cannot be written.
    """
    run = RunOutput.read(Path(output_dir))
    sections = [_header(run), _tiles(run.metrics), *_map_sections(run)]
    sections += [_trajectory(run), _errors(run), _time(run), _tracking(run)]
    sections += [_paper_table(run.metrics), _figures(run.metrics), _settings(run)]
    page = _PAGE.format(title=html.escape(_title(run)), style=STYLE, body="\n".join(sections))
    path = run.folder.report
    atomic_write(path, page)
    return path


_PAGE = """<!doctype html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<title>{title}</title>
<style>{style}</style>
</head>
<body>
<main>
{body}
</main>
</body>
</html>
"""


def _title(run: RunOutput) -> str:
    return f"spslam: {run.folder.path.resolve().name}"


def _header(run: RunOutput) -> str:
    known = run.metrics
    facts = [known.get("device_name"), f"spslam {known['version']}" if "version" in known else None]
    facts.append(f"seed {known['seed']}" if "seed" in known else None)
    text = " · ".join(html.escape(str(fact)) for fact in facts if fact)
    return f"<header><h1>{html.escape(run.folder.path.resolve().name)}</h1><p>{text}</p></header>"


def _tiles(metrics: dict[str, Any]) -> str:
    tiles = [
        f"<div><dt>{name}</dt><dd>{form.format(metrics[key])}</dd></div>"
        for name, key, form in _TILES
        if metrics.get(key) is not None
    ]
    return f'<dl class="tiles">{"".join(tiles)}</dl>'


def _map_sections(run: RunOutput) -> list[str]:
    mesh, previews = run.mesh(), run.previews()
    if mesh is None or not len(run.trajectory):
        return []
    if run.camera is None:
        return [_section("Map", _overview(run, mesh, mesh.faces))]
    faces = report_images.outward_faces(mesh, run.camera, run.trajectory.poses[0])
    sections = [_section("Map", _overview(run, mesh, faces))]
    views = [_view(run, mesh, run.camera, preview) for preview in _spread(previews, VIEWS)]
    if views:
        note = "Input images, and the mesh rendered from the estimated poses"
        sections.append(_section("Views", "".join(views), note))
    return sections


def _overview(run: RunOutput, mesh: Mesh, faces: np.ndarray) -> str:
    image = report_images.render_overview(mesh, faces, run.trajectory.poses)
    caption = "The mesh from above, without the walls nearest to the viewer, and the camera trajectory; "
    caption += f"{len(mesh.vertices):,} vertices, {len(mesh.faces):,} faces"
    return _figure(image, 1200, caption, "map")


def _spread(previews: list[Preview], count: int) -> list[Preview]:
    rows = np.unique(np.linspace(0, len(previews) - 1, min(count, len(previews))).round().astype(int))
    return [previews[row] for row in rows]


def _view(run: RunOutput, mesh: Mesh, camera: Camera, preview: Preview) -> str:
    """A row of images: input and rendered color, input depth if it was kept, rendered depth."""
    pose = run.trajectory.poses[preview.row]
    color, depth = render_mesh(mesh.vertices, mesh.faces, mesh.colors, camera, pose, supersampling=2)
    limits = report_images.depth_limits(depth if preview.depth is None else preview.depth)
    images = [
        _figure(preview.color, 480, f"frame {preview.row}, input"),
        _figure(color, 480, "mesh"),
    ]
    if preview.depth is not None:
        images.append(_figure(report_images.colorize_depth(preview.depth, *limits), 480, "input depth"))
    scale = f"mesh depth, yellow {limits[0]:.1f} m to violet {limits[1]:.1f} m"
    images.append(_figure(report_images.colorize_depth(depth, *limits), 480, scale))
    return f'<div class="row">{"".join(images)}</div>'


def _trajectory(run: RunOutput) -> str:
    if not len(run.trajectory):
        return ""
    estimate, ground_truth = _aligned_positions(run)
    # Top view in the world frame of the estimate, to which the ground truth is aligned.
    axes = report_images.top_axes(run.trajectory.poses)
    origin = estimate[0]
    top_ground_truth = None if ground_truth is None else (ground_truth - origin) @ axes
    chart = charts.trajectory_chart((estimate - origin) @ axes, top_ground_truth, run.trajectory.lost)
    length = np.linalg.norm(np.diff(estimate, axis=0), axis=1).sum()
    return _section("Trajectory", chart, f"top view; {length:.2f} m long")


def _errors(run: RunOutput) -> str:
    estimate, ground_truth = _aligned_positions(run) if len(run.trajectory) else (np.zeros((0, 3)), None)
    if ground_truth is None:
        return ""
    estimate = np.where(run.trajectory.lost[:, None], np.nan, estimate)
    difference = (
        100 * (estimate - ground_truth) @ np.column_stack([report_images.top_axes(run.trajectory.poses), _up(run)])
    )
    series = [charts.Series(name, name[0], column) for name, column in zip(_AXES, difference.T, strict=True)]
    series.append(charts.Series("distance", "total", np.linalg.norm(difference, axis=1)))
    chart = charts.line_chart(series, "cm", run.trajectory.lost)
    return _section(
        "Error over time", chart, "position error after rigid alignment, along the axes of the first camera"
    )


_AXES = ("right", "forward", "up")


def _up(run: RunOutput) -> np.ndarray:
    axes = report_images.top_axes(run.trajectory.poses)
    return np.cross(axes[:, 0], axes[:, 1])


def _aligned_positions(run: RunOutput) -> tuple[np.ndarray, np.ndarray | None]:
    """Estimated positions [F, 3], and ground-truth positions aligned with them; None without ground truth."""
    estimate = run.trajectory.poses[:, :3, 3]
    if run.ground_truth is None or run.known_ground_truth is None:
        return estimate, None
    alignment = align(run.trajectory.poses, run.known_ground_truth)
    return estimate, (run.ground_truth[:, :3, 3] - alignment.translation) @ alignment.rotation


def _time(run: RunOutput) -> str:
    if not run.log:
        return ""
    tracking, encoding, mapping = (_column(run, key) / 1000 for key in ("tracking_ms", "encode_ms", "mapping_ms"))
    spent = float(np.nansum(tracking) + np.nansum(encoding) + np.nansum(mapping))
    rest = max(float(run.metrics.get("wall_s", 0.0)) - spent, 0.0)
    bar = charts.stacked_bar(
        [
            ("tracking", "tracking", float(np.nansum(tracking))),
            ("encoding and fusion", "encoding", float(np.nansum(encoding))),
            ("mapping", "mapping", float(np.nansum(mapping))),
            ("reading and other work", "rest", rest),
            ("mesh", "mesh", float(run.metrics.get("mesh_s", 0.0))),
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
    note = f"images are decoded ahead on other threads, {run.metrics.get('decode_ms', 0):.1f} ms/frame"
    first = (
        f"the first mapping took {run.metrics['first_mapping_s']:.2f} s and is not shown; "
        if "first_mapping_s" in run.metrics
        else ""
    )
    return _section("Time", bar + charts.line_chart(series, "ms", run.trajectory.lost), first + note)


def _tracking(run: RunOutput) -> str:
    residual, inlier_share = _column(run, "residual_cm"), 100 * _column(run, "inlier_share")
    if not np.isfinite(residual).any():
        return ""
    lost = run.trajectory.lost if len(run.trajectory) == len(residual) else None
    body = charts.line_chart([charts.Series("residual", "tracking", residual)], "cm", lost)
    body += charts.line_chart([charts.Series("pixels on mapped surface", "encoding", inlier_share)], "%", lost)
    return _section("Tracking", body, "mean distance between the depth image and the map, and how much of it is mapped")


def _column(run: RunOutput, key: str) -> np.ndarray:
    values = [entry.get(key) for entry in run.log]
    return np.array([np.nan if value is None else value for value in values], dtype=float)


# Columns of the paper's Table I: title, keys in metrics.json, format.
_PAPER_COLUMNS = (
    ("Comp. (%)", ("completeness_5cm",), "{:.2f}"),
    ("Accu. (%)", ("accuracy_5cm",), "{:.2f}"),
    ("F1 (%)", ("f1_5cm",), "{:.2f}"),
    ("Track. (ms)", ("tracking_ms_per_iteration", "tracking_iterations"), "{:.2f} × {:.0f}"),
    ("Map. (ms)", ("mapping_ms_per_iteration", "mapping_iterations"), "{:.2f} × {:.0f}"),
    ("Track. FPS", ("tracking_fps",), "{:.2f}"),
    ("Avg. FPS", ("fps",), "{:.2f}"),
    ("#param (MB)", ("model_mb",), "{:.1f}"),
    ("GPU (MB)", ("peak_gpu_mb",), "{:.0f}"),
)


def _paper_table(metrics: dict[str, Any]) -> str:
    known = [
        (title, form.format(*(metrics[key] for key in keys)))
        for title, keys, form in _PAPER_COLUMNS
        if all(metrics.get(key) is not None for key in keys)
    ]
    if not known:
        return ""
    heads = "".join(f"<th>{html.escape(title)}</th>" for title, _ in known)
    cells = "".join(f"<td>{text}</td>" for _, text in known)
    note = "the columns of SP-SLAM's Table I: surface at 5 cm, time per iteration × iterations, size of the parameters"
    return _section("As in the paper", f"<table><tr>{heads}</tr><tr>{cells}</tr></table>", note)


def _figures(metrics: dict[str, Any]) -> str:
    rows = "".join(f"<tr><th>{html.escape(key)}</th><td>{_format(value)}</td></tr>" for key, value in metrics.items())
    return _section("All metrics", f"<table>{rows}</table>", "as in metrics.json")


def _format(value: Any) -> str:
    return f"{value:,.4g}" if isinstance(value, float) and abs(value) < 1e5 else html.escape(str(value))


def _settings(run: RunOutput) -> str:
    if not run.config:
        return ""
    return f"<section><details><summary>Settings</summary><pre>{html.escape(run.config)}</pre></details></section>"


def _section(title: str, body: str, note: str = "") -> str:
    if not body:
        return ""
    below = f"<p>{html.escape(note)}</p>" if note else ""
    return f"<section><h2>{html.escape(title)}</h2>{below}{body}</section>"


def _figure(image: np.ndarray, max_width: int, caption: str, kind: str = "view") -> str:
    source = report_images.png_uri(image, max_width)
    text = html.escape(caption)
    return f'<figure class="{kind}"><img src="{source}" alt="{text}"><figcaption>{text}</figcaption></figure>'
