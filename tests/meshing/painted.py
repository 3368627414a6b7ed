"""Walls with a known pattern, seen by frames that are computed exactly."""

from __future__ import annotations

import numpy as np

from spslam.camera import Camera
from spslam.datasets.base import RgbdDataset, RgbdFrame
from spslam.errors import DatasetError
from spslam.meshing import TriangleMesh
from spslam.meshing.frame_fusion import PosedFrames
from spslam.meshing.mesh import vertex_normals

CAMERA = Camera(160, 120, 130.0, 130.0, 79.5, 59.5)
NOISE = (1e-6, 1e-7)
RED = np.array([250.0, 20.0, 20.0])
GRAY = 90
# Rectangles: a corner, the vectors along two sides (m), and whether it is red. The wall and the floor have the pattern;
# the red sign stands before the wall. Vectors are such that their product points at the cameras.
WALL = (np.array([-1.2, -0.8, 2.0]), np.array([0, 1.6, 0.0]), np.array([2.4, 0, 0.0]), False)
FLOOR = (np.array([-1.2, 0.8, 0.6]), np.array([2.4, 0, 0.0]), np.array([0, 0, 1.4]), False)
SIGN = (np.array([-0.2, -0.3, 1.5]), np.array([0, 0.4, 0.0]), np.array([0.4, 0, 0.0]), True)


def pattern(points: np.ndarray) -> np.ndarray:
    """Colors float64 [N, 3] of points, smooth at 5 cm."""
    x, y, z = (9 * points).T
    bands = [np.sin(x + 0.7 * y + 0.4 * z), np.sin(1.3 * y - 0.5 * x + z), np.cos(0.8 * x - y + 0.6 * z)]
    return 120 + 60 * np.stack(bands, axis=1)


def grid(rectangle, step_m: float = 0.04) -> tuple[np.ndarray, np.ndarray]:
    """Vertices and faces of a rectangle."""
    corner, u, v, _ = rectangle
    across, down = (max(round(np.linalg.norm(side) / step_m), 1) for side in (u, v))
    i, j = (each.ravel() for each in np.meshgrid(np.arange(across + 1), np.arange(down + 1), indexing="ij"))
    vertices = corner + i[:, None] / across * u + j[:, None] / down * v
    first = (np.arange(across)[:, None] * (down + 1) + np.arange(down)).ravel()
    second, third, fourth = first + down + 1, first + down + 2, first + 1
    return vertices, np.concatenate([np.stack([first, second, third], 1), np.stack([first, third, fourth], 1)])


def mesh_of(*rectangles, step_m: float = 0.04) -> TriangleMesh:
    """One gray mesh of all, whose common vertices are one."""
    parts = [grid(each, step_m) for each in rectangles]
    offsets = np.cumsum([0, *(len(vertices) for vertices, _ in parts)])
    vertices = np.concatenate([vertices for vertices, _ in parts]).astype(np.float32)
    faces = np.concatenate([faces + offset for (_, faces), offset in zip(parts, offsets, strict=False)])
    kept, merged = np.unique(vertices.round(5), axis=0, return_inverse=True)
    faces = merged.reshape(-1)[faces].astype(np.int32)
    return TriangleMesh(kept, faces, np.full(kept.shape, GRAY, np.uint8), vertex_normals(kept, faces))


class Painted(RgbdDataset):
    """Frames of rectangles at given poses; colors of frame i are multiplied by `gains[i]`, those in `broken` fail.

    `paint` has the colors of points that are not red.
    """

    name = "painted"
    camera = CAMERA

    def __init__(self, rectangles, poses, gains=None, broken=(), without_depth=False, paint=pattern):
        self.rectangles, self._poses, self.paint = rectangles, poses, paint
        self.gains = np.ones(len(poses)) if gains is None else gains
        self.broken, self.without_depth = broken, without_depth

    def __len__(self):
        return len(self._poses)

    def timestamps(self):
        return np.arange(len(self), dtype=np.float64)

    def poses(self):
        return self._poses

    def read(self, index):
        if index in self.broken:
            raise DatasetError(f"frame {index} is broken")
        pose = self._poses[index]
        rays = CAMERA.ray_directions().reshape(-1, 3).astype(np.float64) @ pose[:3, :3].T
        depth, colors = np.full(len(rays), np.inf), np.zeros((len(rays), 3))
        for corner, u, v, red in self.rectangles:
            normal = np.cross(u, v)
            with np.errstate(divide="ignore"):
                t = ((corner - pose[:3, 3]) @ normal) / (rays @ normal)
            points = pose[:3, 3] + t[:, None] * rays
            a, b = ((points - corner) @ side / (side @ side) for side in (u, v))
            hit = (t > 0) & (t < depth) & (a >= 0) & (a <= 1) & (b >= 0) & (b <= 1)
            depth[hit] = t[hit]
            colors[hit] = RED if red else self.paint(points[hit])
        image = np.clip(np.rint(colors * self.gains[index]), 0, 255).astype(np.uint8).reshape(120, 160, 3)
        known = np.isfinite(depth) & (not self.without_depth)
        depth = np.where(known, depth, 0).astype(np.float32).reshape(120, 160)
        return RgbdFrame(index, float(index), image, depth)


def frames(*rectangles, count: int = 12, **more) -> PosedFrames:
    """Frames from places side by side, which look at the wall and at the floor in turn."""
    poses = np.tile(np.eye(4), (count, 1, 1))
    for index, pose in enumerate(poses):
        down = 0.5 * (index % 2)
        pose[:3, :3] = [[1, 0, 0], [0, np.cos(down), np.sin(down)], [0, -np.sin(down), np.cos(down)]]
        pose[:3, 3] = -0.9 + 1.8 * index / max(count - 1, 1), 0.1 * (index % 3) - 0.2, 0.1
    return PosedFrames(Painted(rectangles, poses, **more), np.arange(count), poses)
