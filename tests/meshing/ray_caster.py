"""Ray casting of a mesh, face by face: the plain reference of the rasterizer and of its colors."""

from dataclasses import dataclass

import numpy as np

from spslam.meshing.render import NEAREST_M


@dataclass(frozen=True)
class RayHits:
    """What each pixel's ray meets first; nothing where `face_ids` is -1.

    Attributes:
        depth: float64 [H, W], m, 0 without.
        face_ids: [H, W].
        shares: float64 [H, W, 3], of the corners in the point met.
        normals: float64 [H, W, 3], unit length, towards the camera.
    """

    depth: np.ndarray
    face_ids: np.ndarray
    shares: np.ndarray
    normals: np.ndarray


def cast(points, faces, camera, cull_back=False):
    """Hits of a mesh in camera axes, by Moeller and Trumbore's intersection."""
    rays = np.stack(
        np.broadcast_arrays(
            (np.arange(camera.width) - camera.cx) / camera.fx,
            ((np.arange(camera.height) - camera.cy) / camera.fy)[:, None],
            1.0,
        ),
        axis=-1,
    )
    shape = rays.shape[:2]
    nearest, ids = np.full(shape, np.inf), np.full(shape, -1)
    shares, normals = np.zeros((*shape, 3)), np.zeros((*shape, 3))
    for face, (a, b, c) in enumerate(points[faces]):
        normal = np.cross(b - a, c - a)
        facing = -rays @ normal
        with np.errstate(divide="ignore", invalid="ignore"):
            depth = (-normal @ a) / facing
            second = np.cross(-a, rays) @ (c - a) / facing
            third = np.cross(rays, -a) @ (b - a) / facing
            hit = (second >= 0) & (third >= 0) & (second + third <= 1) & (depth >= NEAREST_M) & (depth <= nearest)
        hit &= facing > 0 if cull_back else facing != 0
        nearest[hit], ids[hit] = depth[hit], face
        shares[hit] = np.stack([1 - second - third, second, third], axis=-1)[hit]
        normals[hit] = (np.sign(facing)[..., None] * normal / np.linalg.norm(normal))[hit]
    return RayHits(np.where(ids >= 0, nearest, 0), ids, shares, normals)
