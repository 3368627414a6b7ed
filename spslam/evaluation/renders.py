"""Renders the map of a run: color images at the poses of its frames, and depth from novel views."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence

import numpy as np
import torch

from spslam.camera import Camera
from spslam.evaluation.run_output import Mesh
from spslam.geometry import interpolate_pose, inverse, transform_points
from spslam.meshing.render import rasterize
from spslam.scene import Scene

# Novel views lie between two views of the sequence, perturbed with these standard deviations (m, rad).
_MOVED_M, _TURNED = 0.1, np.radians(10)
# A position is in free space if some frame measured a depth at least this far behind it.
_CLEARANCE_M = 0.1
_CANDIDATES_PER_VIEW = 20
# Smallest share of the pixels of a novel view that show observed surface.
_MIN_OBSERVED = 0.5


def render_view(scene: Scene, mesh: Mesh, camera: Camera, T_world_camera: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Renders a map: the visible surface is that of the mesh, its color that of the map.

    Args:
        scene: the map.
        mesh: mesh of the map, in the same world frame.
        camera: intrinsics of the view.
        T_world_camera: [4, 4], pose of the view.

    Returns:
        uint8 [H, W, 3] RGB, black where there is no surface, and float32 [H, W] depth in meters, 0 there.
        Deterministic.
    """
    depth = rasterize(mesh.vertices, mesh.faces, camera, T_world_camera).depth
    shown = depth > 0
    points = transform_points(T_world_camera, camera.unproject(depth)[shown]).astype(np.float32)
    color = np.zeros((camera.height, camera.width, 3), dtype=np.uint8)
    rgb = scene.color(torch.from_numpy(points).to(scene.device))
    color[shown] = (rgb * 255).round().clamp(0, 255).to(torch.uint8).cpu().numpy()
    return color, depth


def novel_poses(
    poses: np.ndarray, depths: Sequence[np.ndarray], camera: Camera, count: int, seed: int = 0
) -> Iterator[np.ndarray]:
    """Generates poses in free space that are not poses of the sequence.

    Each is interpolated between two random views of the sequence, then perturbed by some 10 cm and some 10 degrees
    about a random axis. It is kept if some frame observed that the position is free.

    Args:
        poses: [F, 4, 4] `T_world_camera`, finite.
        depths: depth images [H, W] of the same frames, meters, 0 where unknown.
        camera: intrinsics of the depth images.
        count: 20 times as many candidates are tested.
        seed: the same seed gives the same poses.

    Yields:
        `T_world_camera` [4, 4] of the candidates in free space.
    """
    from scipy.spatial.transform import Rotation

    generator = np.random.default_rng(seed)
    for _ in range(_CANDIDATES_PER_VIEW * count if len(poses) else 0):
        first, second = generator.integers(len(poses), size=2)
        share = generator.uniform(0.2, 0.8)
        moved, turned = generator.normal(scale=_MOVED_M, size=3), generator.normal(scale=_TURNED, size=3)
        pose = interpolate_pose(poses[first], poses[second], share)
        pose[:3, 3] += moved
        pose[:3, :3] = pose[:3, :3] @ Rotation.from_rotvec(turned).as_matrix()
        if _is_free(pose[:3, 3], poses, depths, camera):
            yield pose


def novel_depth(
    estimated: tuple[np.ndarray, np.ndarray],
    reference: tuple[np.ndarray, np.ndarray],
    poses: Iterator[np.ndarray],
    camera: Camera,
    observed: Callable[[np.ndarray], np.ndarray],
    count: int,
) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Renders depth of a reconstructed and of the ground-truth mesh, for `spslam.evaluation.depth_metrics.depth_l1`.

    Args:
        estimated: vertices [V, 3] and faces [L, 3] of the reconstruction.
        reference: vertices and faces of the ground truth, in the same world frame.
        poses: of the views; a view is skipped if observed surface covers less than half of the image.
        camera: intrinsics of the views.
        observed: maps points [n, 3] to a mask [n]; the ground-truth depth of unobserved points is set to 0.
        count: largest number of views.

    Yields:
        Pairs (estimated, reference) of float32 [H, W], meters.
    """
    for pose in poses:
        if count == 0:
            return
        reference_depth = rasterize(*reference, camera, pose).depth
        points = transform_points(pose, camera.unproject(reference_depth).reshape(-1, 3))
        shown = np.flatnonzero(reference_depth)
        unobserved = shown[~observed(points[shown])]
        reference_depth.reshape(-1)[unobserved] = 0
        if np.mean(reference_depth > 0) < _MIN_OBSERVED:
            continue
        yield rasterize(*estimated, camera, pose).depth, reference_depth
        count -= 1


def _is_free(position: np.ndarray, poses: np.ndarray, depths: Sequence[np.ndarray], camera: Camera) -> bool:
    seen_from = np.stack([inverse(pose)[:3] @ np.append(position, 1) for pose in poses])
    pixels = camera.project(seen_from)
    for (u, v), (_, _, z), depth in zip(pixels, seen_from, depths, strict=True):
        if not (-0.5 <= u < camera.width - 0.5 and -0.5 <= v < camera.height - 0.5):  # NaN behind the camera
            continue
        if depth[int(np.floor(v + 0.5)), int(np.floor(u + 0.5))] > z + _CLEARANCE_M:
            return True
    return False
