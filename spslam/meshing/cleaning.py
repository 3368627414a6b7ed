"""Removes spurious faces from an extracted mesh.

The zero level set of a truncated SDF has surface where nothing was measured: a second layer behind the observed
surface, fringes behind depth edges, fragments at the border of the mapped space. Three criteria detect it: a fusion
weight that is small compared with the weights nearby, no camera that sees the front of the face, and a connected
component with a small area.
"""

from __future__ import annotations

import numpy as np
import torch

from spslam import ops
from spslam.camera import Camera
from spslam.meshing.mesh import compact, component_areas
from spslam.scene import SparseVolume

# More views than this add nothing, as neighboring views see the same surface.
MAX_VIEWS = 32
# Faces up to this many edges away from a visible face are kept too, so that a noisy normal does not leave a hole.
_RINGS = 1


def face_support(volume: SparseVolume, vertices: torch.Tensor, faces: torch.Tensor, chunk_faces: int) -> torch.Tensor:
    """Fusion weight at the centroid of each face, relative to the largest weight within one voxel of it.

    Args:
        volume: vertices and their fusion weights.
        vertices: float32 [K, 3], m.
        faces: int64 [L, 3].
        chunk_faces: largest number of faces processed at once.

    Returns:
        float32 [L] in [0, 1]; 1 where all weights nearby are 0, so that a map without fused features is kept.
    """
    weights = torch.stack((volume.weights, _largest_around(volume)), 1)
    shares = [weights.new_zeros(0)]
    for chunk in faces.split(chunk_faces):
        # The centroid lies inside a cell. A corner may lie on its border, where the lookup takes the next cell.
        corner_ids, local_coords, _ = volume.lookup(vertices[chunk].mean(1))
        here, around = ops.trilinear_interpolate(weights, corner_ids, local_coords).unbind(1)
        shares.append(torch.where(around > 0, here / around, 1.0))
    return torch.cat(shares)


def _largest_around(volume: SparseVolume) -> torch.Tensor:
    """The largest weight float32 [V] of each vertex and its 26 neighbors, one axis after the other."""
    largest = volume.weights
    for axis in range(3):
        step = torch.zeros(3, dtype=torch.int32, device=volume.device)
        step[axis] = 1
        along = largest
        for side in (-1, 1):
            ids = ops.voxel_hash_find(volume.hash_keys, volume.hash_values, volume.voxel_coords + side * step).long()
            along = torch.maximum(along, torch.where(ids >= 0, largest[ids.clamp(min=0)], 0.0))
        largest = along
    return largest


def front_facing_in_view(
    vertices: np.ndarray, normals: np.ndarray, faces: np.ndarray, camera: Camera, poses: np.ndarray
) -> np.ndarray:
    """Whether a face, or one near it, lies in the field of view of some camera and faces that camera.

    Occlusion is ignored. At most `MAX_VIEWS` of the poses are tested, evenly spaced.

    Args:
        vertices: float32 [K, 3], world, m.
        normals: float32 [K, 3].
        faces: integers [L, 3].
        camera: pinhole intrinsics of all views.
        poses: [F, 4, 4] T_world_camera; poses that are not finite are skipped.

    Returns:
        bool [L].

    Raises:
        ValueError: no pose is finite.
    """
    poses = poses[np.isfinite(poses).all((1, 2))]
    if len(poses) == 0:
        raise ValueError("front_facing_in_view: poses must have at least one finite pose, got none")
    views = poses[np.unique(np.linspace(0, len(poses) - 1, min(MAX_VIEWS, len(poses))).round().astype(int))]
    faces, used = compact(faces, len(vertices))
    points, normals = (np.ascontiguousarray(each[used].T) for each in (vertices, normals))
    front_facing = np.zeros(len(used), dtype=bool)
    for pose in views:
        remaining = np.flatnonzero(~front_facing)
        front_facing[remaining] = _front_facing(points[:, remaining], normals[:, remaining], camera, pose)
    for _ in range(_RINGS):
        front_facing[faces[front_facing[faces].any(1)]] = True
    return front_facing[faces].any(1)


def _front_facing(points: np.ndarray, normals: np.ndarray, camera: Camera, pose: np.ndarray) -> np.ndarray:
    """Bool [N] of points and normals [3, N]."""
    rotation, center = pose[:3, :3].astype(np.float32), pose[:3, 3].astype(np.float32)
    rays = points - center[:, None]
    # Not @: for such thin products BLAS would start threads on all cores.
    x, y, z = (axis[0] * rays[0] + axis[1] * rays[1] + axis[2] * rays[2] for axis in rotation.T)
    with np.errstate(divide="ignore", invalid="ignore"):
        u, v = camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy
    in_view = (z > 0) & (u >= -0.5) & (u < camera.width - 0.5) & (v >= -0.5) & (v < camera.height - 0.5)
    return in_view & (rays[0] * normals[0] + rays[1] * normals[1] + rays[2] * normals[2] < 0)


def in_large_component(vertices: np.ndarray, faces: np.ndarray, min_area_m2: float) -> np.ndarray:
    """Whether the connected component that a face belongs to has a minimum area.

    Args:
        vertices: float32 [K, 3], m.
        faces: integers [L, 3].
        min_area_m2: minimum area, m^2; 0 keeps everything.

    Returns:
        bool [L].
    """
    if min_area_m2 <= 0 or len(faces) == 0:
        return np.ones(len(faces), dtype=bool)
    return component_areas(vertices, faces) >= min_area_m2
