"""Evaluates a finished run against ground truth: trajectory, mesh and rendered views of the map."""

from __future__ import annotations

import json
from collections.abc import Iterable
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
from spslam.meshing.render import render_colors
from spslam.run_folder import RunFolder
from spslam.scene import Scene

# Frames used to determine which surface was observed; more of them add time, but hardly any surface.
_CULLING_FRAMES = 100
# Number of novel views for depth L1 and of frames for PSNR and SSIM, and the image width of the novel views.
NOVEL_VIEWS, COLOR_VIEWS = 32, 16
_NOVEL_WIDTH_PX = 160
# Keys of metrics.json by what measures them: one that is measured anew, or no longer true, goes with all of its group.
SCALE_KEYS = frozenset({"ate_scaled_rmse_cm", "ate_scaled_median_cm", "ate_scaled_max_cm", "ate_scale"})
SURFACE_KEYS = frozenset(
    {"accuracy_cm", "completeness_cm", "accuracy_5cm", "completeness_5cm", "accuracy_1cm", "completeness_1cm"}
    | {"f1_5cm", "f1_1cm", "depth_l1_cm", "depth_l1_coverage"}
)
VIEW_KEYS = frozenset({"psnr_db", "ssim", "view_coverage"})
MESH_KEYS = frozenset({"mesh_source", "mesh_resolution_m", "mesh_frames", "mesh_mb", "mesh_color_frames", "mesh_s"})


def trajectory_figures(run: RunOutput, with_scale: bool = False) -> dict[str, float]:
    """ATE and RPE by their names in metrics.json.

    Args:
        run: the run.
        with_scale: also compute ATE after alignment with scale, as `ate_scaled_*`.

    Returns:
        Metrics as in `spslam.evaluation.trajectory_metrics`; empty without ground-truth poses.
    """
    ground_truth = run.known_ground_truth
    if ground_truth is None:
        return {}
    figures = {**ate(run.trajectory.poses, ground_truth), **rpe(run.trajectory.poses, ground_truth)}
    return {**figures, **ate(run.trajectory.poses, ground_truth, with_scale=True)} if with_scale else figures


def surface_figures(
    run: RunOutput, dataset: RgbdDataset, ground_truth: Surface, samples: int = SAMPLES, novel_views: int = NOVEL_VIEWS
) -> dict[str, float]:
    """Accuracy, completeness, F1 and depth L1 of the mesh of a run, by their names in metrics.json.

    The mesh is aligned with the ground truth by the rigid transform that best aligns the estimated camera poses with
    the ground-truth poses. It uses the camera centers and points one meter along each camera axis, because the centers
    of a straight trajectory alone do not determine the rotation. Surface that no frame observed is excluded from both
    meshes.

    Args:
        run: a run with a mesh.
        dataset: the dataset of the run, or one that contains its frames; its depth determines what was observed.
        ground_truth: the ground-truth surface.
        samples: points sampled on each surface, 100,000 as in the paper.
        novel_views: number of views for depth L1; 0 leaves it out.

    Returns:
        Metrics as in `spslam.evaluation.mesh_metrics` and `spslam.evaluation.depth_metrics`.

    Raises:
        OutputError: the run has no mesh; it has ground-truth poses, but of no tracked frame; none of its frames with a
            pose is in the dataset, or can be read; or these observed nothing of the ground-truth surface.
    """
    mesh = _require_mesh(run)
    known = run.known_ground_truth
    if known is not None and not np.isfinite(known).any():
        raise OutputError(
            f"{run.folder.path}: no tracked frame has a ground-truth pose, so the mesh can't be aligned with the "
            "ground truth; ground-truth poses of frames that were tracked are needed"
        )
    poses = run.trajectory.mask_lost(run.trajectory.poses) if run.ground_truth is None else run.ground_truth
    rows, depths = _read_depths(run, dataset, *_frames_of(run, dataset, _CULLING_FRAMES, poses))
    vertices = mesh.vertices if known is None else _align_views(run.trajectory.poses, known).apply(mesh.vertices)

    def observed(points: np.ndarray) -> np.ndarray:
        return observed_mask(points, depths, poses[rows], dataset.camera)

    reconstructed = TriangleSurface(vertices, mesh.faces)
    if not len(reconstructed.triangles()[1]):
        raise OutputError(f"{run.folder.path}: no face of its mesh has an area; `spslam mesh` makes another one")
    figures = evaluate_surface(reconstructed, ground_truth, observed, samples)
    if "completeness_cm" not in figures:  # no point to measure from, as there is a surface to measure to
        raise OutputError(_nothing_observed(run, len(rows)))
    if not novel_views:
        return figures
    views = novel_poses(poses[rows], depths, dataset.camera, novel_views)
    height_px = max(round(dataset.camera.height * _NOVEL_WIDTH_PX / dataset.camera.width), 1)
    camera = dataset.camera.resized(_NOVEL_WIDTH_PX, height_px)
    pairs = novel_depth((vertices, mesh.faces), ground_truth.triangles(), views, camera, observed, novel_views)
    return {**figures, **depth_l1(pairs)}


def view_figures(run: RunOutput, dataset: RgbdDataset) -> dict[str, float]:
    """PSNR and SSIM of the rendered map against the input images, by their names in metrics.json.

    The map is rendered from the estimated poses of frames evenly spaced over the run: a mesh that was fused from the
    frames with its own colors, one that was extracted from the map with the map's.

    Args:
        run: a run with a mesh and a map.
        dataset: the dataset of the run, or one that contains its frames.

    Returns:
        `psnr_db` and `ssim`: means over the views, each over the pixels where the map has surface.
        `view_coverage`: percentage of all pixels where it has.
        Empty if no frame can be read or no view shows surface.

    Raises:
        OutputError: the run has no mesh or no map, or none of its tracked frames is in the dataset.
    """
    mesh, map_file = _require_mesh(run), run.folder.map
    if not map_file.is_file():
        raise OutputError(f"{run.folder.path}: has no {map_file.name} to render")
    scene = None if run.metrics.get("mesh_source") == "tsdf" else Scene.load(map_file)
    scores, coverage = [], []
    tracked = run.trajectory.mask_lost(run.trajectory.poses)
    for row, index in zip(*_frames_of(run, dataset, COLOR_VIEWS, tracked), strict=True):
        try:
            frame = dataset[int(index)]
        except DatasetError:
            continue
        pose = run.trajectory.poses[row]
        if scene is None:
            color, depth = render_colors(mesh.vertices, mesh.faces, mesh.colors, dataset.camera, pose)
        else:
            color, depth = render_view(scene, mesh, dataset.camera, pose)
        shown = depth > 0
        coverage.append(100 * float(shown.mean()))
        if shown.any():
            scores.append((psnr_db(color, frame.color, shown), ssim(color, frame.color, shown)))
    if not scores:
        return {}
    ratios, similarities = np.array(scores).T
    figures = {"psnr_db": float(ratios.mean()), "view_coverage": float(np.mean(coverage))}
    # SSIM is NaN for a view whose surface is too fragmented to contain a whole window.
    return figures | ({} if np.isnan(similarities).all() else {"ssim": float(np.nanmean(similarities))})


def add_metrics(run: RunOutput, figures: dict[str, Any], replaced: Iterable[str] = ()) -> dict[str, Any]:
    """Adds metrics to metrics.json.

    Args:
        run: the run.
        figures: metrics by their names.
        replaced: names of metrics that are removed where `figures` has none of the name, as `SURFACE_KEYS`.

    Returns:
        All metrics.

    Raises:
        OutputError: metrics.json can't be written.
    """
    return write_metrics(run.folder, run.metrics, figures, replaced)


def write_metrics(
    folder: RunFolder, known: dict[str, Any], figures: dict[str, Any], replaced: Iterable[str] = ()
) -> dict[str, Any]:
    """As `add_metrics`, of a folder that may be a merged map's, with the metrics `known` of it."""
    gone = set(replaced) - figures.keys()
    metrics = {key: value for key, value in {**known, **figures}.items() if key not in gone}
    atomic_write(folder.metrics, json.dumps(metrics, indent=1) + "\n")
    return metrics


def _require_mesh(run: RunOutput) -> Mesh:
    mesh = run.mesh()
    if mesh is None:
        raise OutputError(f"{run.folder.path}: has no mesh to evaluate; `spslam mesh {run.folder.path}` extracts one")
    return mesh


def _align_views(estimated: np.ndarray, reference: np.ndarray) -> Alignment:
    known = np.isfinite(reference).all(axis=(1, 2))
    # Columns: the camera center, and the points one meter along each camera axis.
    corners = np.array([[0, 0, 0, 1], [1, 0, 0, 1], [0, 1, 0, 1], [0, 0, 1, 1]], dtype=np.float64).T
    points = ((poses[known] @ corners)[:, :3].transpose(0, 2, 1).reshape(-1, 3) for poses in (estimated, reference))
    return Alignment(*umeyama(*points))


def _frames_of(run: RunOutput, dataset: RgbdDataset, count: int, poses: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Evenly spaced rows of the trajectory with a finite pose, and the indices of these frames in the dataset."""
    indices = match_times(dataset.timestamps(), run.trajectory.timestamps)
    if not (indices >= 0).any():
        raise OutputError(f"{run.folder.path}: must be a run over {dataset.name}, but has none of its frames")
    rows = np.flatnonzero((indices >= 0) & np.isfinite(poses).all(axis=(1, 2)))
    if not len(rows):
        raise OutputError(
            f"{run.folder.path}: none of the run's frames that are in {dataset.name} has a known pose to evaluate "
            "from; restore the data of the run, or run it again"
        )
    rows = rows[np.unique(np.linspace(0, len(rows) - 1, count).round().astype(int))]
    return rows, indices[rows]


def _read_depths(
    run: RunOutput, dataset: RgbdDataset, rows: np.ndarray, indices: np.ndarray
) -> tuple[np.ndarray, list[np.ndarray]]:
    """The rows whose frames can be read, and their depth images."""
    readable, depths, unreadable = [], [], ""
    for row, index in zip(rows, indices, strict=True):
        try:
            depths.append(dataset[int(index)].depth)
        except DatasetError as error:
            unreadable = unreadable or str(error)
            continue
        readable.append(row)
    if not readable:
        raise OutputError(
            f"{run.folder.path}: can't tell what was observed, as none of {len(rows)} frames can be read; restore the "
            f"data ({unreadable})"
        )
    return np.array(readable, dtype=np.int64), depths


def _nothing_observed(run: RunOutput, views: int) -> str:
    """Why there is nothing to compare the mesh with."""
    poses = "ground-truth poses; it must be in meters and in their world"
    if run.ground_truth is None:
        poses = "estimated poses; it must be in meters and, as there are no ground-truth poses, in the world of the run"
    return (
        f"{run.folder.path}: nothing of the ground-truth surface is seen in depth images of {views} frames at {poses}"
    )
