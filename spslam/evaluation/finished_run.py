"""A finished run against the truth: its trajectory, its mesh where the camera saw the surface, its map's pictures."""

from __future__ import annotations

import json
from typing import Any

import numpy as np

from spslam.datasets.base import RgbdDataset
from spslam.errors import DatasetError, OutputError
from spslam.evaluation.depth_metrics import depth_l1
from spslam.evaluation.image_metrics import psnr_db, ssim
from spslam.evaluation.mesh_metrics import SAMPLES, evaluate_surface, observed_mask
from spslam.evaluation.renders import novel_depth, novel_poses, render_view
from spslam.evaluation.run_output import Mesh, RunOutput, match_times
from spslam.evaluation.surface import Surface, TriangleSurface
from spslam.evaluation.trajectory_metrics import Alignment, ate, rpe
from spslam.geometry import umeyama
from spslam.io import atomic_write
from spslam.scene import Scene

# Frames that decide what was observed; more of a sequence's neighbors add nothing but time.
_CULLING_FRAMES = 100
# Views whose depth, and frames whose color, is compared; and the width of the former.
NOVEL_VIEWS, COLOR_VIEWS = 32, 16
_NOVEL_WIDTH_PX = 160


def trajectory_figures(run: RunOutput, with_scale: bool = False) -> dict[str, float]:
    """ATE and RPE as metrics.json names them; empty where no true pose is known.

    With ``with_scale`` also ATE after alignment by a similarity, under names of its own.
    """
    ground_truth = run.known_ground_truth
    if ground_truth is None:
        return {}
    figures = {**ate(run.trajectory.poses, ground_truth), **rpe(run.trajectory.poses, ground_truth)}
    return {**figures, **ate(run.trajectory.poses, ground_truth, with_scale=True)} if with_scale else figures


def surface_figures(
    run: RunOutput, dataset: RgbdDataset, ground_truth: Surface, samples: int = SAMPLES, novel_views: int = NOVEL_VIEWS
) -> dict[str, float]:
    """Accuracy, completeness, F1 and depth from novel views of the run's mesh, as metrics.json names them.

    The mesh is carried into the truth's world by the rigid motion that best carries estimated onto true views (camera
    centers and points a meter away from them: the centers of a straight path alone leave a rotation open); surface that
    no frame observed is left out on both sides.

    Parameters
    ----------
    run : with a mesh.
    dataset : the one that the run was over, or that it took its frames from; its depth says what was observed.
    truth : the true surface.
    samples : points compared each way, 100,000 as in the paper.
    novel_views : views whose depth is compared; 0 leaves those figures out.

    Raises
    ------
    OutputError
        When the run has no mesh, or none of its frames is in the dataset.
    """
    mesh = _require_mesh(run)
    known = run.known_ground_truth
    rows, indices = _frames_of(run, dataset, _CULLING_FRAMES, known_only=run.ground_truth is None)
    poses = run.trajectory.poses if run.ground_truth is None else run.ground_truth
    rows, depths = _read_depths(dataset, rows, indices)
    vertices = mesh.vertices if known is None else _align_views(run.trajectory.poses, known).apply(mesh.vertices)

    def observed(points: np.ndarray) -> np.ndarray:
        return observed_mask(points, depths, poses[rows], dataset.camera)

    figures = evaluate_surface(TriangleSurface(vertices, mesh.faces), ground_truth, observed, samples)
    if not novel_views:
        return figures
    known = np.flatnonzero(np.isfinite(poses[rows]).all(axis=(1, 2)))
    views = novel_poses(poses[rows][known], [depths[row] for row in known], dataset.camera, novel_views)
    height_px = max(round(dataset.camera.height * _NOVEL_WIDTH_PX / dataset.camera.width), 1)
    camera = dataset.camera.resized(_NOVEL_WIDTH_PX, height_px)
    pairs = novel_depth((vertices, mesh.faces), ground_truth.triangles(), views, camera, observed, novel_views)
    return {**figures, **depth_l1(pairs)}


def view_figures(run: RunOutput, dataset: RgbdDataset) -> dict[str, float]:
    """How like the input the map looks from where its frames were taken, as metrics.json names it.

    The map is drawn from the estimated poses of frames spread evenly over the run.

    Parameters
    ----------
    run : with a mesh and a map.
    dataset : the one that the run was over, or that it took its frames from.

    Returns
    -------
    ``psnr_db`` and ``ssim`` : means over the views, each over the pixels where the map has surface.
    ``view_coverage`` : percent of all pixels where it has.
    Empty when no frame can be read or none shows surface.

    Raises
    ------
    OutputError
        When the run has no mesh or no map, or none of its frames is in the dataset.
    """
    mesh, map_file = _require_mesh(run), run.folder.map
    if not map_file.is_file():
        raise OutputError(f"{run.folder.path}: has no {map_file.name} to draw")
    scene = Scene.load(map_file)
    likeness, coverage = [], []
    for row, index in zip(*_frames_of(run, dataset, COLOR_VIEWS, known_only=True), strict=True):
        try:
            frame = dataset[int(index)]
        except DatasetError:
            continue
        color, depth = render_view(scene, mesh, dataset.camera, run.trajectory.poses[row])
        shown = depth > 0
        coverage.append(100 * float(shown.mean()))
        if shown.any():
            likeness.append((psnr_db(color, frame.color, shown), ssim(color, frame.color, shown)))
    if not likeness:
        return {}
    ratios, similarities = np.array(likeness).T
    figures = {"psnr_db": float(ratios.mean()), "view_coverage": float(np.mean(coverage))}
    # A view that shows specks of surface only has no whole window to compare.
    return figures | ({} if np.isnan(similarities).all() else {"ssim": float(np.nanmean(similarities))})


def add_metrics(run: RunOutput, figures: dict[str, Any]) -> dict[str, Any]:
    """Write metrics.json with further figures; returns all of them."""
    metrics = {**run.metrics, **figures}
    atomic_write(run.folder.metrics, json.dumps(metrics, indent=1) + "\n")
    return metrics


def _require_mesh(run: RunOutput) -> Mesh:
    mesh = run.mesh()
    if mesh is None:
        raise OutputError(f"{run.folder.path}: has no mesh to evaluate; spslam mesh {run.folder.path} makes one")
    return mesh


def _align_views(estimated: np.ndarray, reference: np.ndarray) -> Alignment:
    known = np.isfinite(reference).all(axis=(1, 2))
    # Columns: the camera's center, and the points a meter along its axes.
    corners = np.array([[0, 0, 0, 1], [1, 0, 0, 1], [0, 1, 0, 1], [0, 0, 1, 1]], dtype=np.float64).T
    points = ((poses[known] @ corners)[:, :3].transpose(0, 2, 1).reshape(-1, 3) for poses in (estimated, reference))
    return Alignment(*umeyama(*points))


def _frames_of(run: RunOutput, dataset: RgbdDataset, count: int, known_only: bool) -> tuple[np.ndarray, np.ndarray]:
    """Rows of the run's trajectory, spread evenly, and the dataset's numbers of those frames."""
    indices = match_times(dataset.timestamps(), run.trajectory.timestamps)
    rows = np.flatnonzero((indices >= 0) & ~(run.trajectory.lost & known_only))
    if not len(rows):
        raise OutputError(f"{run.folder.path}: must be a run over {dataset.name}, but has none of its frames")
    rows = rows[np.unique(np.linspace(0, len(rows) - 1, count).round().astype(int))]
    return rows, indices[rows]


def _read_depths(dataset: RgbdDataset, rows: np.ndarray, indices: np.ndarray) -> tuple[np.ndarray, list[np.ndarray]]:
    """Depth images of frames, and the rows of those that can be read."""
    readable, depths = [], []
    for row, index in zip(rows, indices, strict=True):
        try:
            depths.append(dataset[int(index)].depth)
        except DatasetError:
            continue
        readable.append(row)
    return np.array(readable, dtype=np.int64), depths
