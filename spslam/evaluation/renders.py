"""A run's map as pictures: what its own cameras should have seen, and depth from where no camera stood."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from spslam.camera import Camera
from spslam.evaluation.run_output import Mesh
from spslam.geometry import interpolate_pose, inverse, transform_points
from spslam.meshing.render import rasterize
from spslam.scene import Scene

# Novel views: between two views of the sequence, moved and turned about by these standard deviations.
_MOVED_M, _TURNED = 0.1, np.radians(10)
# A place is free if some frame looked at least this far past it.
_CLEARANCE_M = 0.1
_CANDIDATES_A_VIEW = 20
# Of a novel view this share of the pixels must show surface that was observed.
_MIN_OBSERVED = 0.5


def render_view(scene: Scene, mesh: Mesh, camera: Camera, T_world_camera: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A map's picture: the mesh says which surface a pixel shows, the map which color it has there.

    Parameters
    ----------
    scene : the map.
    mesh : its surface, in the map's world.
    camera : whose view it is.
    T_world_camera : [4,4].

    Returns
    -------
    uint8 [H,W,3] RGB, black where there is no surface, and float32 [H,W] depth in meters, 0 there. Deterministic.
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
    """Poses in free space from which no frame was taken.

    Each lies between two random views of the sequence, moved by some 10 cm and turned by some 10 degrees about a
    random axis, at a place that a frame looked through.

    Parameters
    ----------
    poses : [F,4,4] ``T_world_camera``, finite.
    depths : depth images [H,W] of the same frames, meters, 0 where unknown.
    camera : of the depth images.
    count : 20 times as many candidates are tried; those in free space are given.
    seed : the same seed gives the same poses.
    """
    generator = np.random.default_rng(seed)
    for _ in range(_CANDIDATES_A_VIEW * count if len(poses) else 0):
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
    """Depth images of a reconstructed and of the true surface, for :func:`spslam.evaluation.depth_metrics.depth_l1`.

    Parameters
    ----------
    estimated, reference : vertices [V,3] and faces [L,3], in one world.
    poses : of the views; ones that show less than half a picture of observed surface are passed over.
    camera : of the views.
    observed : gives the mask [n] of points [n,3]; true depth of points outside it is 0 in what is returned.
    count : most views.

    Returns
    -------
    Pairs (estimated, reference) of float32 [H,W], meters.
    """
    for pose in poses:
        if count == 0:
            return
        true_depth = rasterize(*reference, camera, pose).depth
        points = transform_points(pose, camera.unproject(true_depth).reshape(-1, 3))
        shown = np.flatnonzero(true_depth)
        hidden = shown[~observed(points[shown])]
        true_depth.reshape(-1)[hidden] = 0
        if np.mean(true_depth > 0) < _MIN_OBSERVED:
            continue
        yield rasterize(*estimated, camera, pose).depth, true_depth
        count -= 1


def _is_free(place: np.ndarray, poses: np.ndarray, depths: Sequence[np.ndarray], camera: Camera) -> bool:
    seen_from = np.stack([inverse(pose)[:3] @ np.append(place, 1) for pose in poses])
    pixels = camera.project(seen_from)
    for (u, v), (_, _, z), depth in zip(pixels, seen_from, depths, strict=True):
        if not (-0.5 <= u < camera.width - 0.5 and -0.5 <= v < camera.height - 0.5):  # NaN behind the camera
            continue
        if depth[int(np.floor(v + 0.5)), int(np.floor(u + 0.5))] > z + _CLEARANCE_M:
            return True
    return False
