"""Which faces of a map's surface to keep.

Truncation leaves surface where nothing was measured: a second sheet behind the seen one, lips behind depth edges, bits
where the field ran out. Three signs tell them: little was fused there beside where much was, no camera can have seen
them from the front, and they are small and loose.
"""

from __future__ import annotations

import numpy as np
import torch

from spslam import ops
from spslam.camera import Camera
from spslam.meshing.mesh import face_components, face_normals
from spslam.scene import SparseVolume

# More views than this add nothing: neighboring ones see the same.
MAX_VIEWS = 32
# Faces this many steps away from a seen one are kept too, so that a noisy normal makes no hole.
_RINGS = 1


def face_support(volume: SparseVolume, vertices: torch.Tensor, faces: torch.Tensor, chunk_faces: int) -> torch.Tensor:
    """Fusion weight at the middle of each face, as a share of the largest one within a voxel around.

    Args:
        volume: weights and where they are.
        vertices: float32 [K, 3], m.
        faces: int64 [L, 3].
        chunk_faces: most faces looked at together.

    Returns:
        float32 [L] in [0, 1]; 1 where nothing was fused all around, so that a map without fusion is kept whole.
    """
    weights = torch.stack((volume.weights, _largest_around(volume)), 1)
    shares = [weights.new_zeros(0)]
    for some in faces.split(chunk_faces):
        # The middle lies within a cell; the corners may lie on its border, where the next cell is asked.
        corner_ids, local_coords, _ = volume.lookup(vertices[some].mean(1))
        here, around = ops.trilinear_interpolate(weights, corner_ids, local_coords).unbind(1)
        shares.append(torch.where(around > 0, here / around, 1.0))
    return torch.cat(shares)


def _largest_around(volume: SparseVolume) -> torch.Tensor:
    """The largest weight float32 [V] among a vertex and its 26 neighbors, one axis after the other."""
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


def faced_by_a_camera(
    vertices: np.ndarray, normals: np.ndarray, faces: np.ndarray, camera: Camera, poses: np.ndarray
) -> np.ndarray:
    """Bool [L]: whether a face, or one near it, is in the view of some camera and turned towards it.

    What hides it is not looked at. At most `MAX_VIEWS` of the poses, evenly spread, are tried.

    Args:
        vertices: float32 [K, 3], world, m.
        normals: float32 [K, 3].
        faces: integers [L, 3].
        camera: pinhole intrinsics of all views.
        poses: [F, 4, 4] T_world_camera; not finite ones are skipped.

    Raises:
        ValueError: no pose is finite.
    """
    poses = poses[np.isfinite(poses).all((1, 2))]
    if len(poses) == 0:
        raise ValueError("faced_by_a_camera: poses must hold a finite one, got none")
    views = poses[np.unique(np.linspace(0, len(poses) - 1, min(MAX_VIEWS, len(poses))).round().astype(int))]
    faced = np.zeros(len(vertices), dtype=bool)
    for pose in views:
        unsure = np.flatnonzero(~faced)
        faced[unsure] = _faces_view(vertices[unsure], normals[unsure], camera, pose)
    for _ in range(_RINGS):
        faced[faces[faced[faces].any(1)]] = True
    return faced[faces].any(1)


def _faces_view(points: np.ndarray, normals: np.ndarray, camera: Camera, pose: np.ndarray) -> np.ndarray:
    rotation, center = pose[:3, :3].astype(np.float32), pose[:3, 3].astype(np.float32)
    rays = points - center
    x, y, z = (rays @ rotation).T
    with np.errstate(divide="ignore", invalid="ignore"):
        u, v = camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy
    in_view = (z > 0) & (u >= -0.5) & (u < camera.width - 0.5) & (v >= -0.5) & (v < camera.height - 0.5)
    return in_view & (np.einsum("ij,ij->i", rays, normals) < 0)


def in_large_part(vertices: np.ndarray, faces: np.ndarray, min_area_m2: float) -> np.ndarray:
    """Bool [L]: whether the connected part that a face belongs to has at least an area.

    Args:
        vertices: float32 [K, 3], m.
        faces: integers [L, 3].
        min_area_m2: 0 keeps everything.
    """
    if min_area_m2 <= 0 or len(faces) == 0:
        return np.ones(len(faces), dtype=bool)
    part = face_components(faces, len(vertices))
    areas = np.linalg.norm(face_normals(vertices, faces), axis=1) / 2
    return np.bincount(part, areas)[part] >= min_area_m2
