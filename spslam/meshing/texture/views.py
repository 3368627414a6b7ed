"""Which frames saw each vertex of a mesh best: what a texture is made of."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from spslam.camera import Camera
from spslam.datasets.base import RgbdFrame
from spslam.datasets.prefetch import prefetch
from spslam.errors import DatasetError
from spslam.geometry import inverse
from spslam.meshing.depth_views import NEAR_DEVIATIONS, NEAR_M
from spslam.meshing.frame_fusion import PosedFrames
from spslam.meshing.mesh import TriangleMesh
from spslam.meshing.reading import reading_threads

NEAREST_M = 0.05
# A surface seen flatter than this is not taken: cosine of the angle of incidence.
LEAST_COSINE = 0.15
# Side of the cells of the coarse depth image by which a vertex is hidden where nothing was measured, px.
_CELL_PX = 4
# A depth step of this share is an edge; colors count fully from so many pixels away from one, and from the border.
_EDGE_SHARE, _EDGE_PX, _BORDER_PX = 0.05, 6.0, 16.0
# What a frame's color counts where its depth is unknown.
_UNMEASURED = 0.3


@dataclass(frozen=True)
class ColorView:
    """One frame as a texture sees it.

    Attributes:
        number: of the frame among all parts, from 0.
        frame: color and depth.
        camera: intrinsics.
        pose: float64 [4, 4] T_world_camera.
        noise: floor (m^2) and growth (1/m^2) of the variance of its depth.
    """

    number: int
    frame: RgbdFrame
    camera: Camera
    pose: np.ndarray
    noise: tuple[float, float]

    def projection(self) -> np.ndarray:
        """float32 [3, 4], from (x, y, z, 1) in the world, m, to (u z, v z, z), px m and m."""
        return (self.camera.matrix() @ inverse(self.pose)[:3]).astype(np.float32)

    def homogeneous(self, points: np.ndarray) -> np.ndarray:
        """Where points float32 [N, 3] in the world fall in the image: float32 [N, 3] of (u z, v z, z), px m and m."""
        matrix = self.projection()
        places = np.empty((len(points), 3), np.float32)
        for row in range(3):  # not @: for such thin products BLAS would start threads on all cores
            places[:, row] = matrix[row, 0] * points[:, 0]
            places[:, row] += matrix[row, 1] * points[:, 1]
            places[:, row] += matrix[row, 2] * points[:, 2] + matrix[row, 3]
        return places

    def project(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Pixel coordinates and depths of points float32 [N, 3] in the world: u, v (px) and z (m), float32 [N].

        Of points that are not in front of the camera, u and v say nothing.
        """
        x, y, z = self.homogeneous(points).T
        scale = 1 / np.maximum(z, np.float32(NEAREST_M))
        return x * scale, y * scale, z


def read_views(parts: Sequence[PosedFrames], noise: tuple[float, float]) -> Iterator[ColorView]:
    """All frames of all parts in order; those that can't be read are left out, the others keep their numbers."""
    first = 0
    for part in parts:
        with prefetch(part, *reading_threads(part.dataset.readers)) as frames:
            for position, frame in enumerate(frames):
                if not isinstance(frame, DatasetError):
                    camera, pose = part.dataset.camera, part.poses[position]
                    yield ColorView(first + position, part.covered(frame), camera, pose, part.noise or noise)
        first += len(part)


@dataclass(frozen=True)
class SeenVertices:
    """What one frame saw.

    Attributes:
        ids: int64 [N] of the vertices, ascending.
        u, v: float32 [N], px.
        scores: float32 [N], above 0: how well it saw them.
        footprints_m: float32 [N], the edge of a pixel on the surface.
    """

    ids: np.ndarray
    u: np.ndarray
    v: np.ndarray
    scores: np.ndarray
    footprints_m: np.ndarray


def seen_vertices(mesh: TriangleMesh, view: ColorView) -> SeenVertices:
    """The vertices that a frame sees from their front, and how well."""
    camera = view.camera
    u, v, z = view.project(mesh.vertices)
    ids = np.flatnonzero(
        (z > NEAREST_M) & (u > -0.5) & (v > -0.5) & (u < camera.width - 0.5) & (v < camera.height - 0.5)
    )
    u, v, z = u[ids], v[ids], z[ids]
    coarse = _coarse_depth(u, v, z, camera)
    rays = mesh.vertices[ids] - view.pose[:3, 3].astype(np.float32)
    length = np.sqrt(np.einsum("ij,ij->i", rays, rays))
    cosine = -np.einsum("ij,ij->i", rays, mesh.normals[ids]) / length
    x, y = np.rint(u).astype(np.int32), np.rint(v).astype(np.int32)
    footprint = z / np.float32(0.5 * (camera.fx + camera.fy))
    tangent = np.sqrt(np.maximum(1 - cosine**2, 0)) / np.maximum(cosine, LEAST_COSINE)
    slope = footprint * tangent
    # Visible?
    front = coarse[y // _CELL_PX, x // _CELL_PX]
    measured = view.frame.depth[y, x]
    known = measured > 0
    tolerance = NEAR_M + NEAR_DEVIATIONS * np.sqrt(view.noise[0] + view.noise[1] * z**4) + slope
    apart = np.abs(measured - z) / tolerance
    agreement = np.where(known, np.maximum(1 - apart**2, 0) ** 2, np.float32(_UNMEASURED))
    visible = (cosine > LEAST_COSINE) & (agreement > 0) & (z < front + NEAR_M + 2 * _CELL_PX * slope)
    # How well?
    edges = _edge_distance(view.frame.depth)[y, x]
    border = np.minimum(np.minimum(u, camera.width - 1 - u), np.minimum(v, camera.height - 1 - v)) + 1
    scores = cosine**2 / footprint**2 * agreement
    scores *= np.clip(edges / _EDGE_PX, 0.05, 1) * np.clip(border / _BORDER_PX, 0.01, 1)
    kept = np.flatnonzero(visible)
    return SeenVertices(ids[kept], u[kept], v[kept], scores[kept].astype(np.float32), footprint[kept])


def _coarse_depth(u: np.ndarray, v: np.ndarray, z: np.ndarray, camera: Camera) -> np.ndarray:
    """Smallest depth float32 [h, w] of points in cells of an image; holes are filled by their neighbors."""
    width, height = camera.width // _CELL_PX + 1, camera.height // _CELL_PX + 1
    cells = (np.rint(v).astype(np.int32) // _CELL_PX) * width + np.rint(u).astype(np.int32) // _CELL_PX
    flat = np.full(width * height, np.float32(np.inf))
    np.minimum.at(flat, cells, z)
    nearest: np.ndarray = flat.reshape(height, width)
    for _ in range(2):
        nearest = np.where(np.isinf(nearest), cv2.erode(nearest, np.ones((3, 3), np.uint8)), nearest)
    return nearest


def _edge_distance(depth: np.ndarray) -> np.ndarray:
    """Distance (px) of each pixel from a depth edge, float32 [H, W]."""
    filled = np.where(depth > 0, depth, np.float32(np.nan))
    edges = np.zeros(depth.shape, np.uint8)
    for a, b in ((np.s_[:, 1:], np.s_[:, :-1]), (np.s_[1:], np.s_[:-1])):
        step = np.abs(filled[a] - filled[b]) > _EDGE_SHARE * np.minimum(filled[a], filled[b])
        edges[a] |= step
        edges[b] |= step
    return cv2.distanceTransform(1 - edges, cv2.DIST_L2, 3)


class BestViews:
    """The frames that saw each vertex best.

    Attributes:
        numbers: int32 [V, K] of frames, -1 for none.
        scores: float32 [V, K], 0 for none.
    """

    def __init__(self, vertices: int, views: int) -> None:
        self.numbers = np.full((vertices, views), -1, np.int32)
        self.scores = np.zeros((vertices, views), np.float32)

    def add(self, number: int, ids: np.ndarray, scores: np.ndarray) -> None:
        """Takes a frame in where it is better than the worst that a vertex has."""
        held = self.scores[ids]
        slot = held.argmin(1)
        better = np.flatnonzero(scores > np.take_along_axis(held, slot[:, None], 1)[:, 0])
        self.numbers[ids[better], slot[better]] = number
        self.scores[ids[better], slot[better]] = scores[better]
