"""What a Jupyter notebook shows of a run, a mesh and a trajectory: HTML that needs nothing from elsewhere."""

from __future__ import annotations

import html
import math
import sys
import time
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

_SIZE_PX = 320
_MARGIN_PX = 14
# A picture needs no more points of a path.
_MAX_POINTS = 2000
# A notebook keeps what it shows: 30 bytes per face.
_MAX_FACES = 400_000
_MAX_TILT = math.radians(60)
_COLORS = {"path": "#266cc4", "lost": "#be00be", "start": "#00966e", "end": "#ce2029"}
_SECONDS_BETWEEN_UPDATES = 0.25


def in_notebook() -> bool:
    """Whether this process is the kernel of a Jupyter notebook."""
    ipython = sys.modules.get("IPython")
    shell = ipython.get_ipython() if ipython is not None else None
    return shell is not None and type(shell).__name__ == "ZMQInteractiveShell"


def table_html(rows: Mapping[str, str], caption: str) -> str:
    """A small table of names and values, escaped."""
    cells = "".join(
        f'<tr><th style="text-align:left">{html.escape(name)}</th><td>{html.escape(value)}</td></tr>'
        for name, value in rows.items()
    )
    return f"<table><caption><b>{html.escape(caption)}</b></caption>{cells}</table>"


def trajectory_html(timestamps: np.ndarray, poses: np.ndarray, lost: np.ndarray) -> str:
    """A path seen along the axis in which it extends least, with its figures.

    Args:
        timestamps: [F], s.
        poses: [F, 4, 4] T_world_camera.
        lost: bool [F].
    """
    centers, known = np.asarray(poses)[:, :3, 3], ~np.asarray(lost)
    steps = np.linalg.norm(np.diff(centers[known], axis=0), axis=1) if known.any() else np.zeros(0)
    duration = float(timestamps[-1] - timestamps[0]) if len(timestamps) else 0.0
    rows = {
        "frames": f"{len(known)}" + (f" ({int((~known).sum())} lost)" if not known.all() else ""),
        "path": f"{steps.sum():.2f} m",
        "duration": f"{duration:.1f} s",
    }
    return _beside(_path_svg(centers, known), table_html(rows, "Trajectory"))


def mesh_html(vertices: np.ndarray, faces: np.ndarray, colors: np.ndarray) -> str:
    """A mesh to be turned around with the mouse, by trimesh's viewer in one frame, and its figures.

    Args:
        vertices: [V, 3], m.
        faces: [L, 3].
        colors: uint8 [V, 3] RGB.
    """
    rows = {"vertices": f"{len(vertices):,}", "faces": f"{len(faces):,}"}
    if not len(faces):
        return table_html(rows, "Mesh")
    size = np.ptp(vertices, axis=0)
    rows["size"] = " x ".join(f"{length:.2f}" for length in size) + " m"

    if len(faces) > _MAX_FACES:
        return table_html({**rows, "view": f"not shown beyond {_MAX_FACES:,} faces"}, "Mesh")

    import trimesh
    from trimesh.viewer.notebook import scene_to_html

    axes, tilt = _facing(np.asarray(vertices), np.asarray(faces))
    shown = trimesh.Trimesh(vertices @ axes.T, faces, vertex_colors=colors, process=False)
    scene = trimesh.Scene(shown)
    scene.camera_transform = scene.camera.look_at(shown.vertices, rotation=tilt)
    page = html.escape(scene_to_html(scene), quote=True)
    frame = f'<iframe srcdoc="{page}" style="width:100%;height:420px;border:0" loading="lazy"></iframe>'
    return frame + table_html(rows, "Mesh")


class RunProgress:
    """The progress of a run in a notebook cell; `run_sequence` shows one by itself where it is given no other.

    Called after each frame, as `spslam.run.loop.Progress`.
    """

    def __init__(self) -> None:
        self._done, self._total, self._lost, self._skipped = 0, 0, 0, 0
        self._first_s = self._shown_s = 0.0
        self._state = "starting"
        self._handle: Any = None

    def __call__(self, done: int, total: int, report: Any) -> None:
        now = time.monotonic()
        if not self._done:
            self._first_s, self._first = now, done
        self._done, self._total = done, total
        self._skipped += report is None
        if report is not None:
            self._lost += bool(report.lost)
            residual = report.fit.residual_cm
            fit = "" if math.isnan(residual) else f", residual {residual:.2f} cm"
            self._state = ("LOST" if report.lost else "tracked") + fit
        if done >= total or now - self._shown_s >= _SECONDS_BETWEEN_UPDATES:
            self._shown_s = now
            self._show()

    def _repr_html_(self) -> str:
        share = self._done / max(self._total, 1)
        spent_s = self._shown_s - self._first_s
        rate = f", {(self._done - self._first) / spent_s:.1f} frames/s" if self._done and spent_s > 0 else ""
        counts = "".join(
            f", {number} {word}" for number, word in ((self._lost, "lost"), (self._skipped, "skipped")) if number
        )
        bar = f'<progress value="{share:.4f}" max="1" style="width:20em"></progress>'
        return f"<div>{bar} {self._done}/{self._total} frames{rate}{counts}; {html.escape(self._state)}</div>"

    def _show(self) -> None:
        display = getattr(sys.modules.get("IPython"), "display", None)
        if display is None:
            return
        if self._handle is None:
            self._handle = display.display(self, display_id=True)
        else:
            self._handle.update(self)


def _facing(vertices: np.ndarray, faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """How to see the front of most faces, as back faces are not drawn.

    Returns:
        The axes [3, 3] to show the mesh in: right, up and towards the viewer, where up is -y as of OpenCV's first
        camera; and the rotation [4, 4] by which the view is tilted.
    """
    a, b, c = (np.asarray(vertices, np.float64)[faces[:, corner]] for corner in range(3))
    fronts = np.cross(b - a, c - a).sum(axis=0)
    up = np.array([0.0, -1.0, 0.0])
    level = fronts - (fronts @ up) * up
    level = level / np.linalg.norm(level) if np.linalg.norm(level) > 1e-9 else np.array([0.0, 0.0, -1.0])
    angle = -float(np.clip(np.arctan2(fronts @ up, fronts @ level), 0.0, _MAX_TILT))
    tilt = np.eye(4)
    tilt[1:3, 1:3] = [[math.cos(angle), -math.sin(angle)], [math.sin(angle), math.cos(angle)]]
    return np.stack([np.cross(up, level), up, level]), tilt


def _path_svg(centers: np.ndarray, known: np.ndarray) -> str:
    """The path as SVG; gaps are dashed."""
    if not known.any():
        return ""
    middle = centers[known].mean(axis=0)
    axes = np.linalg.svd(centers[known] - middle, full_matrices=False)[2] if known.sum() > 2 else np.eye(3)
    plane = (centers - middle) @ axes[:2].T
    low, high = plane[known].min(axis=0), plane[known].max(axis=0)
    scale = (_SIZE_PX - 2 * _MARGIN_PX) / max(float((high - low).max()), 1e-6)
    places = (plane - (low + high) / 2) * scale + _SIZE_PX / 2
    rows = np.flatnonzero(known)
    rows = rows[np.unique(np.linspace(0, len(rows) - 1, min(len(rows), _MAX_POINTS)).round().astype(int))]
    points = " ".join(f"{x:.1f},{y:.1f}" for x, y in places[rows])
    gaps = [(rows[i], rows[i + 1]) for i in range(len(rows) - 1) if not known[rows[i] : rows[i + 1]].all()]
    dashes = "".join(_line(places[a], places[b]) for a, b in gaps)
    marks = "".join(
        f'<circle cx="{x:.1f}" cy="{y:.1f}" r="4" fill="{_COLORS[name]}"><title>{name}</title></circle>'
        for (x, y), name in ((places[rows[0]], "start"), (places[rows[-1]], "end"))
    )
    path = f'<polyline points="{points}" fill="none" stroke="{_COLORS["path"]}" stroke-width="1.5"/>'
    return f'<svg width="{_SIZE_PX}" height="{_SIZE_PX}" role="img" aria-label="trajectory">{path}{dashes}{marks}</svg>'


def _line(start: Sequence[float], end: Sequence[float]) -> str:
    x1, y1, x2, y2 = (f"{value:.1f}" for value in (*start, *end))
    stroke = f'stroke="{_COLORS["lost"]}" stroke-width="3" stroke-dasharray="4 3"'
    return f'<line x1="{x1}" y1="{y1}" x2="{x2}" y2="{y2}" {stroke}/>'


def _beside(left: str, right: str) -> str:
    return f'<div style="display:flex;flex-wrap:wrap;gap:1em;align-items:center">{left}{right}</div>'
