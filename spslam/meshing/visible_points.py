"""Which points of a surface a frame sees, and how many of its pixels each has."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np

from spslam.meshing.texture.views import NEAREST_M, ColorView

# A point is hidden where the surface's nearest points around its pixel lie so much before it: meters, and pixels along a
# slanted surface. It is seen from angles up to this cosine; flatter views have next to no pixels for it.
_APART_M, _APART_PX, _LEAST_COSINE = 0.004, 2.0, 0.02
# The nearest points hide what lies between them: gaps of less than so many pixels are closed. More would close gaps that
# there are, as between the legs of a chair; of near surface, whose points are farther from each other, depth is measured.
_CLOSED_PX = 3
# A measured depth hides what lies so much behind it: meters and deviations of the noise.
_BEHIND_M, _BEHIND_DEVIATIONS = 0.02, 3.0
# Points that are looked for in a view together; they lie next to each other in a mesh.
_RUN = 1024


@dataclass(frozen=True)
class VisiblePoints:
    """What one frame sees of surface points.

    Attributes:
        ids: int64 [N] of the points, ascending.
        u, v: float32 [N], px.
        weights: float32 [N], above 0: pixels per area of surface, 1/m^2.
    """

    ids: np.ndarray
    u: np.ndarray
    v: np.ndarray
    weights: np.ndarray


class SurfacePoints:
    """Points of a surface, to be looked for in frames.

    Args:
        points: float32 [N, 3], world, m; next to each other in space where they are in the array, for speed alone.
        normals: float32 [N, 3], unit vectors towards free space.
    """

    def __init__(self, points: np.ndarray, normals: np.ndarray) -> None:
        self._points, self._normals = points, normals
        starts = np.arange(0, len(points), _RUN)
        low, high = (
            each.reduceat(points, starts) if len(points) else np.zeros((0, 3), np.float32)
            for each in (np.minimum, np.maximum)
        )
        self._centers = 0.5 * (low + high)
        self._radii = 0.5 * np.linalg.norm(high - low, axis=1)

    def __len__(self) -> int:
        return len(self._points)

    def seen_by(self, view: ColorView) -> VisiblePoints:
        """The points that a frame sees from their front.

        What hides others is the points themselves, drawn into a depth buffer, and the frame's depth. Depth that was
        measured behind a point does not hide it, nor does unknown depth: the colors that a frame has there are those
        that the surface is seen with.
        """
        camera = view.camera
        ids = self._near(view)
        u, v, z = view.project(self._points[ids])
        inside = (z > NEAREST_M) & (u >= 0) & (v >= 0) & (u <= camera.width - 1) & (v <= camera.height - 1)
        ids, u, v, z = ids[inside], u[inside], v[inside], z[inside]
        rays = self._points[ids] - view.pose[:3, 3].astype(np.float32)
        cosine = -np.einsum("ij,ij->i", rays, self._normals[ids]) / np.sqrt(np.einsum("ij,ij->i", rays, rays))
        pixel_m = z / np.float32(0.5 * (camera.fx + camera.fy))
        bounded = np.clip(cosine, 0.15, 1)
        slope = pixel_m * np.sqrt(1 - bounded**2) / bounded
        places = np.rint(v).astype(np.int32) * camera.width + np.rint(u).astype(np.int32)
        front = _nearest(places, z, (camera.height, camera.width))
        noise = np.sqrt(view.noise[0] + view.noise[1] * z**4)
        measured = view.frame.depth.reshape(-1)[places]
        hidden = (measured > 0) & (z > measured + _BEHIND_M + _BEHIND_DEVIATIONS * noise + slope)
        kept = np.flatnonzero((z < front[places] + _APART_M + _APART_PX * slope) & (cosine > _LEAST_COSINE) & ~hidden)
        return VisiblePoints(ids[kept], u[kept], v[kept], cosine[kept] / pixel_m[kept] ** 2)

    def _near(self, view: ColorView) -> np.ndarray:
        """int64, ascending: the points of all runs that reach into the field of view."""
        camera = view.camera
        u, v, z = view.project(self._centers)
        reach = self._radii / np.maximum(z - self._radii, np.float32(NEAREST_M))
        # A ball's outline is farther from its center's image off the axis; twice is enough for any lens without fisheye.
        near = z - self._radii < 4 * self._radii
        across, down = 2 * reach * camera.fx, 2 * reach * camera.fy
        inside = (u > -across) & (u < camera.width + across) & (v > -down) & (v < camera.height + down)
        runs = np.flatnonzero((z + self._radii > NEAREST_M) & (inside | near))
        ids = (runs[:, None] * _RUN + np.arange(_RUN)).reshape(-1)
        return ids[ids < len(self._points)]


def _nearest(places: np.ndarray, z: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """Depth float32 [H * W] of the nearest points, with gaps between them closed; infinite where there is none."""
    drawn = np.full(size[0] * size[1], np.float32(np.inf))
    np.minimum.at(drawn, places, z)
    square = np.ones((_CLOSED_PX, _CLOSED_PX), np.uint8)
    # Near is small, so closing gaps is an erosion and a dilation.
    closed = cv2.dilate(cv2.erode(drawn.reshape(size), square), square).reshape(-1)
    return np.minimum(drawn, closed)
