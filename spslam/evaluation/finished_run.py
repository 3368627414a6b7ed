"""A finished run against the truth: its trajectory, and its mesh where the camera saw the surface."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np

from spslam.datasets.base import RgbdDataset
from spslam.errors import OutputError
from spslam.evaluation.mesh import evaluate_surface, observed_mask
from spslam.evaluation.run_output import RunOutput, match_times
from spslam.evaluation.surface import Surface, TriangleSurface
from spslam.evaluation.trajectory import Alignment, ate, rpe
from spslam.geometry import umeyama
from spslam.io import atomic_write

# Frames that decide what was observed; more of a sequence's neighbours add nothing but time.
_CULLING_FRAMES = 100


def trajectory_figures(run: RunOutput) -> dict[str, float]:
    """ATE and RPE as metrics.json names them; empty where no true pose is known."""
    if run.truth is None:
        return {}
    return {**ate(run.trajectory.poses, run.truth), **rpe(run.trajectory.poses, run.truth)}


def surface_figures(run: RunOutput, dataset: RgbdDataset, truth: Surface) -> dict[str, float]:
    """Accuracy, completeness and F1 of the run's mesh, as metrics.json names them.

    The mesh is carried into the truth's world by the rigid motion that best carries estimated onto true views (camera
    centres and points a metre away from them: the centres of a straight path alone leave a rotation open); surface that
    no frame observed is left out on both sides.

    Parameters
    ----------
    run : with a mesh.
    dataset : the one that the run was over, or that it took its frames from; its depth says what was observed.
    truth : the true surface.

    Raises
    ------
    OutputError
        When the run has no mesh, or none of its frames is in the dataset.
    """
    mesh = run.mesh()
    if mesh is None:
        raise OutputError(f"{run.folder}: has no mesh to evaluate; spslam mesh {run.folder} makes one")
    rows, indices = _frames_of(run, dataset)
    poses = run.trajectory.poses if run.truth is None else run.truth
    vertices = (
        mesh.vertices if run.truth is None else _align_views(run.trajectory.poses, run.truth).apply(mesh.vertices)
    )
    depths = [dataset[int(index)].depth for index in indices]

    def observed(points: np.ndarray) -> np.ndarray:
        return observed_mask(points, depths, poses[rows], dataset.camera)

    return evaluate_surface(TriangleSurface(vertices, mesh.faces), truth, observed)


def add_metrics(run: RunOutput, figures: dict[str, Any]) -> dict[str, Any]:
    """Write metrics.json with further figures; returns all of them."""
    metrics = {**run.metrics, **figures}
    atomic_write(Path(run.folder) / "metrics.json", json.dumps(metrics, indent=1) + "\n")
    return metrics


def _align_views(estimated: np.ndarray, reference: np.ndarray) -> Alignment:
    known = np.isfinite(reference).all(axis=(1, 2))
    # Columns: the camera's centre, and the points a metre along its axes.
    corners = np.array([[0, 0, 0, 1], [1, 0, 0, 1], [0, 1, 0, 1], [0, 0, 1, 1]], dtype=np.float64).T
    points = ((poses[known] @ corners)[:, :3].transpose(0, 2, 1).reshape(-1, 3) for poses in (estimated, reference))
    return Alignment(*umeyama(*points))


def _frames_of(run: RunOutput, dataset: RgbdDataset) -> tuple[np.ndarray, np.ndarray]:
    """Rows of the run's trajectory, spread evenly, and the dataset's numbers of those frames."""
    indices = match_times(dataset.timestamps(), run.trajectory.timestamps)
    rows = np.flatnonzero(indices >= 0)
    if not len(rows):
        raise OutputError(f"{run.folder}: must be a run over {dataset.name}, but has none of its frames")
    rows = rows[np.unique(np.linspace(0, len(rows) - 1, _CULLING_FRAMES).round().astype(int))]
    return rows, indices[rows]
