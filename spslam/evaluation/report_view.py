"""The report's 3-D view: what `web/view3d.js` shows, packed into the page."""

from __future__ import annotations

import html
from typing import Any

import numpy as np

from spslam.evaluation import report_images
from spslam.evaluation.html_parts import web_file
from spslam.evaluation.report_charts import aligned_positions, drawn_ground_truth
from spslam.evaluation.run_output import Mesh, RunOutput
from spslam.evaluation.verdict import number
from spslam.evaluation.web_data import encode_bytes, encode_json, pack_arrays, pack_mesh
from spslam.geometry import matrix_to_quaternion
from spslam.meshing.load import MAX_COORDINATE_M
from spslam.meshing.simplify import simplify_mesh

LIBRARY = "three.min.js"
# What a phone draws smoothly; 6 to 8 bytes of text each.
MAX_FACES = 300_000
_FEWEST_FACES = 1000
# Steps of the slider; the path is drawn through them.
_MAX_POSES = 4000
# Where a run saved no intrinsics: the shape of a usual image, 60 degrees wide.
_UNKNOWN_CAMERA = {"width": 4, "height": 3, "fx": 3.464, "fy": 3.464, "cx": 2.0, "cy": 1.5}
# Layers that can be switched: name in the script, label.
_LAYERS = (
    ("mesh", "mesh"),
    ("backs", "backs of walls"),
    ("path", "path"),
    ("lost", "lost"),
    ("truth", "ground truth"),
    ("frustums", "cameras"),
    ("current", "this frame"),
)
_OFF_AT_FIRST = "backs"


def packed_mesh(mesh: Mesh) -> dict[str, Any] | None:
    """A mesh as the page's script reads it, of so many faces as a phone draws; None where none is left."""
    return _packed(simplify_mesh(mesh, MAX_FACES))


def view_3d(run: RunOutput, mesh: Mesh | None, packed: dict[str, Any] | None, still: str, max_bytes: int) -> str:
    """The 3-D view of a run.

    Args:
        run: the run, of at least one frame.
        mesh: its mesh with the front faces towards the observed space; None shows the path alone.
        packed: that mesh by `packed_mesh`.
        still: HTML that stands for the view in print and where there is no WebGL.
        max_bytes: largest size of the result. The mesh is simplified until it fits; the rest always does that fits
            into 1 MB.

    Returns:
        HTML with the data and the library in it; its scripts are for the page to add.
    """
    scene, present = _path(run)
    scene |= _placement(run, mesh)
    library = f'<script type="text/plain" id="view-library">{encode_bytes(web_file(LIBRARY).encode())}</script>'
    shown = [(name, label) for name, label in _LAYERS if name in present or (mesh is not None and name in _OF_MESH)]
    parts = [_controls(shown, scene["frames"]), f'<div class="still">{still}</div>', library]
    if mesh is not None:
        used = sum(len(part.encode()) for part in parts) + len(encode_json(scene))
        scene["mesh"] = _fitting_mesh(mesh, packed, max_bytes - used)
    data = f'<script type="application/json" id="view-data">{encode_json(scene)}</script>'
    return f'<div class="view3d" id="view3d">{"".join(parts)}{data}</div>'


_OF_MESH = ("mesh", "backs")


def _fitting_mesh(mesh: Mesh, packed: dict[str, Any] | None, max_bytes: int) -> dict[str, Any] | None:
    """The packed mesh, or one of fewer faces that fits into so many bytes; None if not even a coarse one does."""
    while packed is not None:
        size = len(encode_json(packed))
        if size <= max_bytes:
            return packed
        count = int(0.95 * packed["faces"] * max(max_bytes, 0) / size)
        packed = _packed(simplify_mesh(mesh, count)) if count >= _FEWEST_FACES else None
    return None


def _packed(mesh: Mesh) -> dict[str, Any] | None:
    """None without faces: a mesh of nothing but slivers may have none left."""
    return pack_mesh(mesh) if len(mesh.faces) else None


def _path(run: RunOutput) -> tuple[dict[str, Any], set[str]]:
    """Poses, ground truth and frustums, and which layers they make."""
    trajectory = run.trajectory
    rows = _slider_rows(trajectory.lost)
    arrays = {
        "rows": rows.astype(np.uint32),
        "positions": _within_reach(trajectory.poses[rows, :3, 3]).astype(np.float32),
        "quaternions": matrix_to_quaternion(trajectory.poses[rows, :3, :3]).astype(np.float32),
        "times": (trajectory.timestamps[rows] - trajectory.timestamps[0]).astype(np.float32),
        "lost": trajectory.lost[rows].astype(np.uint8),
    }
    layers = {"path", "frustums", "current"} | ({"lost"} if trajectory.lost.any() else set())
    if len(run.log) == len(trajectory):
        probability = [number(run.log[row].get("error_probability")) for row in rows]
        arrays["probability"] = np.array(probability, dtype=np.float32)
    _, truth = aligned_positions(run)
    if truth is not None:
        arrays["truth"] = _within_reach(drawn_ground_truth(truth)[rows]).astype(np.float32)
        layers.add("truth")
    return {"frames": len(trajectory), "poses": pack_arrays(arrays), "mesh": None}, layers


def _slider_rows(lost: np.ndarray) -> np.ndarray:
    """All frames of a run, or of a long one evenly spread ones and where tracking was lost and found again."""
    count = len(lost)
    spread = np.unique(np.linspace(0, count - 1, min(count, _MAX_POSES)).round().astype(np.int64))
    changes = np.flatnonzero(np.diff(lost.astype(int)))
    changes = np.concatenate([changes, changes + 1])
    return np.union1d(spread, changes) if len(changes) <= _MAX_POSES else spread


def _placement(run: RunOutput, mesh: Mesh | None) -> dict[str, Any]:
    """From where the view looks at first, and the camera's image."""
    poses = run.trajectory.poses
    up, back = report_images.upright_axes(poses)[1:]
    points = _within_reach(poses[:, :3, 3])
    low, high = points.min(axis=0), points.max(axis=0)
    if mesh is not None:
        of_mesh = np.percentile(mesh.vertices, (1, 99), axis=0)
        low, high = np.minimum(low, of_mesh[0]), np.maximum(high, of_mesh[1])
    camera = _UNKNOWN_CAMERA if run.camera is None else vars(run.camera)
    return {
        "up": up.tolist(),
        "back": back.tolist(),
        "center": ((low + high) / 2).tolist(),
        "radius": max(float(np.linalg.norm(high - low)) / 2, 0.2),
        "camera": {key: float(camera[key]) for key in _UNKNOWN_CAMERA},
    }


def _within_reach(points: np.ndarray) -> np.ndarray:
    """Points, none so far away that the numbers of a page or a GPU end; a path may be wrong by anything."""
    return np.clip(points, -MAX_COORDINATE_M, MAX_COORDINATE_M)


def _controls(layers: list[tuple[str, str]], frames: int) -> str:
    """Canvas, switches and slider; the script shows them when the view works."""
    boxes = "".join(
        f'<label><input type="checkbox" data-layer="{name}"{"" if name == _OFF_AT_FIRST else " checked"}/>'
        f'<span class="key view-{name}"></span>{html.escape(label)}</label>'
        for name, label in layers
    )
    return f"""<div class="live" hidden>
<div class="stage"><canvas tabindex="0" aria-label="3-D view of the map and the camera path"></canvas>
<p class="hint">drag to turn; wheel (after a click) or two fingers to zoom; right button or two fingers to move</p>
</div>
<div class="timeline"><button type="button" data-action="play" aria-label="play">&#9654;</button>
<input type="range" min="0" max="0" value="0" step="1" aria-label="frame, of {frames}"/><output></output></div>
<div class="switches">{boxes}<label><input type="checkbox" data-action="follow"/>look through the camera</label>
<button type="button" data-action="top">from above</button>
<button type="button" data-action="reset">reset</button></div>
</div>
<p class="without" hidden></p><noscript><p>Without JavaScript: a still picture in place of the 3-D view, and charts
without values where they are pointed at.</p></noscript>"""
