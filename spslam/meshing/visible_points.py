"""Which points of a surface frames see, with which colors, and how many of their pixels each point has."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from spslam.datasets.prefetch import prefetch
from spslam.errors import DatasetError
from spslam.meshing.frame_fusion import PosedFrames
from spslam.meshing.texture.bake import sample
from spslam.meshing.texture.views import NEAREST_M, ColorView

# A point is hidden where the surface's nearest points around its pixel lie so much before it: meters, and pixels along
# a slanted surface. It is seen from angles up to the first cosine; flatter views have next to no pixels for it. The
# slant itself is bounded by the second.
_APART_M, _APART_PX, _LEAST_COSINE, _SLANTED_COSINE = 0.004, 2.0, 0.02, 0.15
# The nearest points hide what lies between them: gaps of less than so many pixels are closed. More would close gaps
# that there are, as between the legs of a chair; of near surface, with points farther apart, depth is measured.
_CLOSED_PX = 3
# A measured depth hides what lies so much behind it: meters and deviations of the noise.
_BEHIND_M, _BEHIND_DEVIATIONS = 0.02, 3.0
# Points that are looked for in a view together; they lie next to each other in a mesh.
_RUN = 1024
_WORKERS, _AHEAD = 2, 4


@dataclass(frozen=True)
class SeenPoints:
    """What one frame sees of surface points.

    Attributes:
        ids: int64 [N] of the points, ascending.
        colors: uint8 [N, 3] RGB.
        weights: float32 [N], above 0: pixels per area of surface, 1/m^2.
    """

    ids: np.ndarray
    colors: np.ndarray
    weights: np.ndarray


class SurfacePoints:
    """Points of a surface, to be looked for in frames.

    Args:
        points: float32 [N, 3], world, m; next to each other in space where they are in the array, for speed alone.
        normals: float32 [N, 3], unit vectors towards free space.
    """

    def __init__(self, points: np.ndarray, normals: np.ndarray) -> None:
        self._points, self._normals = _in_runs(points), _in_runs(normals)
        low, high = np.nanmin(self._points, axis=2), np.nanmax(self._points, axis=2)
        self._centers = np.ascontiguousarray(0.5 * (low + high).T)
        self._radii = 0.5 * np.linalg.norm(high - low, axis=0)

    def seen_by(self, view: ColorView) -> SeenPoints:
        """The points that a frame sees from their front.

        What hides others is the points themselves, drawn into a depth buffer, and the frame's depth. Depth that was
        measured behind a point does not hide it, nor does unknown depth: the colors that a frame has there are those
        that the surface is seen with.
        """
        camera, runs = view.camera, self._near(view)
        points = self._points[:, runs].reshape(3, -1)
        # Not @: for such thin products BLAS would start threads on all cores.
        across, down, z = (a * points[0] + b * points[1] + (c * points[2] + d) for a, b, c, d in view.projection())
        inside = np.flatnonzero(
            (z > NEAREST_M)
            & (across >= 0)
            & (down >= 0)
            & (across <= (camera.width - 1) * z)
            & (down <= (camera.height - 1) * z)
        )
        z = z[inside]
        u, v = across[inside] / z, down[inside] / z
        rays = points[:, inside] - view.pose[:3, 3:].astype(np.float32)
        cosine = self._normals[:, runs].reshape(3, -1)[:, inside]
        cosine = -np.einsum("ij,ij->j", rays, cosine) / np.sqrt(np.einsum("ij,ij->j", rays, rays))
        pixel_m = z / np.float32(0.5 * (camera.fx + camera.fy))
        bounded = np.clip(cosine, _SLANTED_COSINE, 1)
        slope = pixel_m * np.sqrt(1 - bounded**2) / bounded
        places = np.rint(v).astype(np.int32) * camera.width + np.rint(u).astype(np.int32)
        front = _nearest(places, z, (camera.height, camera.width))[places] + _APART_M + _APART_PX * slope
        noise = np.sqrt(view.noise[0] + view.noise[1] * z**4)
        measured = view.frame.depth.reshape(-1)[places]
        hidden = (measured > 0) & (z > measured + _BEHIND_M + _BEHIND_DEVIATIONS * noise + slope)
        kept = np.flatnonzero((z < front) & (cosine > _LEAST_COSINE) & ~hidden)
        rows = inside[kept]
        colors = sample(view.frame.color, u[kept], v[kept])
        return SeenPoints(runs[rows // _RUN] * _RUN + rows % _RUN, colors, cosine[kept] / pixel_m[kept] ** 2)

    def _near(self, view: ColorView) -> np.ndarray:
        """int64, ascending: the runs that reach into the field of view."""
        camera = view.camera
        u, v, z = view.project(self._centers)
        # A ball's outline is farther from its center's image off the axis; twice is enough without a fisheye lens.
        reach = 2 * self._radii / np.maximum(z - self._radii, np.float32(NEAREST_M))
        across, down = reach * camera.fx, reach * camera.fy
        inside = (u > -across) & (u < camera.width + across) & (v > -down) & (v < camera.height + down)
        # Of balls around the camera the center says nothing.
        return np.flatnonzero((z + self._radii > NEAREST_M) & (inside | (z < 5 * self._radii)))


def read_seen(surface: SurfacePoints, parts: Sequence[PosedFrames], noise: tuple[float, float]) -> Iterator[SeenPoints]:
    """What all frames of all parts see of a surface, in order; frames that can't be read are left out.

    Args:
        surface: the points.
        parts: the frames.
        noise: of depth where a part has none of its own, floor (m^2) and growth (1/m^2) of the variance.
    """
    for part in parts:
        with prefetch(_Sights(surface, part, part.noise or noise), _WORKERS, _AHEAD) as sights:
            for seen in sights:
                if not isinstance(seen, DatasetError):
                    yield seen


@dataclass(frozen=True)
class _Sights:
    """What each frame sees, worked out on the threads that read."""

    surface: SurfacePoints
    part: PosedFrames
    noise: tuple[float, float]

    def __len__(self) -> int:
        return len(self.part)

    def __getitem__(self, position: int) -> SeenPoints:
        frame = self.part[position]
        return self.surface.seen_by(
            ColorView(position, frame, self.part.dataset.camera, self.part.poses[position], self.noise)
        )


def _in_runs(vectors: np.ndarray) -> np.ndarray:
    """float32 [3, R, 1024] of vectors [N, 3], the last run filled up with NaN."""
    runs = -(-len(vectors) // _RUN)
    filled = np.full((3, runs * _RUN), np.float32(np.nan))
    filled[:, : len(vectors)] = vectors.T
    return filled.reshape(3, runs, _RUN)


def _nearest(places: np.ndarray, z: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """Depth float32 [H * W] of the nearest points, with gaps between them closed; infinite where there is none."""
    drawn = np.full(size[0] * size[1], np.float32(np.inf))
    np.minimum.at(drawn, places, z)
    square = np.ones((_CLOSED_PX, _CLOSED_PX), np.uint8)
    # Near is small, so closing gaps is an erosion and a dilation.
    closed = cv2.dilate(cv2.erode(drawn.reshape(size), square), square).reshape(-1)
    return np.minimum(drawn, closed)
