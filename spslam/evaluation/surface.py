"""Triangle meshes as surfaces to sample and to measure distances to."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Protocol

import numpy as np
from scipy.spatial import cKDTree

from spslam.errors import DatasetError
from spslam.meshing import load_mesh

# Faces are looked up at sites spread over them, about this far apart; no point of a face is farther from its nearest
# site than 1.1 times that.
_SITE_SPACING_M = 0.02
_REACH = 1.1
_MOST_SITES_ALONG = 512
# Of all faces together, unless there are as many faces: a building of 5,000 m2; they take half a gigabyte.
_MOST_SITES = 1 << 24
# Sites compared at first, and at last where the nearest face isn't settled.
_SITES_COMPARED = (8, 32, 128)


class Surface(Protocol):
    """What the metrics need of a surface: evenly spread points and distances, in meters."""

    def sample_surface(self, count: int, seed: int = 0) -> np.ndarray:
        """Points [count,3] spread evenly by area; the same for the same count and seed."""

    def distance(self, points: np.ndarray) -> np.ndarray:
        """Distance [N] of points [N,3] to the surface; infinite when it is empty."""

    def triangles(self) -> tuple[np.ndarray, np.ndarray]:
        """Vertices [V,3] and faces [L,3] to draw it with."""


class TriangleSurface:
    """A mesh; the triangles need no order, orientation or connection.

    Parameters
    ----------
    vertices : [V,3], meters, finite.
    faces : [F,3], indices of vertices.
    """

    def __init__(self, vertices: np.ndarray, faces: np.ndarray) -> None:
        vertices, faces = np.asarray(vertices, dtype=np.float64), np.asarray(faces, dtype=np.int64)
        if vertices.ndim != 2 or vertices.shape[1] != 3 or faces.ndim != 2 or faces.shape[1] != 3:
            raise ValueError(
                "TriangleSurface: vertices and faces must have shapes (V, 3) and (F, 3), "
                f"got {vertices.shape} and {faces.shape}"
            )
        if faces.size and not 0 <= faces.min() <= faces.max() < len(vertices):
            raise ValueError(
                f"TriangleSurface: faces must index {len(vertices)} vertices, got {faces.min()}..{faces.max()}"
            )
        corners = vertices[faces]
        areas = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1) / 2
        self._vertices, self._faces = vertices, faces[areas > 0]
        self._corners = corners[areas > 0]
        self._areas = areas[areas > 0]

    @classmethod
    def load(cls, path: Path) -> TriangleSurface:
        """The mesh in a file; raises DatasetError as `spslam.meshing.load_mesh`, and where it has no faces."""
        mesh = load_mesh(path)
        if not len(mesh.faces):
            raise DatasetError(f"{path}: must be a mesh with faces, got none")
        return cls(mesh.vertices, mesh.faces)

    def triangles(self) -> tuple[np.ndarray, np.ndarray]:
        """Vertices [V,3] and faces [L,3], those of no area left out."""
        return self._vertices, self._faces

    @property
    def area_m2(self) -> float:
        """Sum of the triangles' areas."""
        return float(self._areas.sum())

    def sample_surface(self, count: int, seed: int = 0) -> np.ndarray:
        """Points spread evenly by area, float64 [count,3]; [0,3] for a mesh without area.

        Faces are chosen by stratified draws along the sum of areas, so that every part gets its share to within one
        point; the place in a face is uniform. The same input gives the same points.
        """
        if count == 0 or not len(self._corners):
            return np.zeros((0, 3))
        generator = np.random.default_rng(seed)
        cumulative = np.cumsum(self._areas)
        strata = (np.arange(count) + generator.uniform(size=count)) / count * cumulative[-1]
        faces = np.minimum(np.searchsorted(cumulative, strata, side="right"), len(cumulative) - 1)
        root, share = np.sqrt(generator.uniform(size=(count, 1))), generator.uniform(size=(count, 1))
        a, b, c = np.moveaxis(self._corners[faces], 1, 0)
        return (1 - root) * a + root * (1 - share) * b + root * share * c

    def distance(self, points: np.ndarray) -> np.ndarray:
        """Distance [N] in meters of points [N,3] to the nearest triangle; infinite for a mesh without area.

        Faces are found by the sites closest to a point, as many as it takes to be sure that no other face is closer,
        128 at most. So the distance is exact up to about 10 cm from the surface, and farther off at most a few
        millimeters too long. Deterministic. Raises DatasetError for a surface of thousands of square meters.
        """
        points = np.asarray(points, dtype=np.float64).reshape(-1, 3)
        distance = np.full(len(points), np.inf)
        if not len(self._corners):
            return distance
        unsettled, compared = np.arange(len(points)), 0
        for count in _SITES_COMPARED:
            distance[unsettled], settled = self._nearest_among(points[unsettled], distance[unsettled], compared, count)
            unsettled, compared = unsettled[~settled], count
        return distance

    def _nearest_among(
        self, points: np.ndarray, distance: np.ndarray, first: int, last: int
    ) -> tuple[np.ndarray, np.ndarray]:
        """Distances to the faces of the ``first``-th to ``last``-th closest sites, and whether they are settled."""
        tree, faces, reach = self._sites
        ranks = np.arange(first + 1, min(last, len(faces)) + 1)
        if not len(points) or not len(ranks):
            return distance, np.ones(len(points), dtype=bool)
        site_distance, sites = tree.query(points, k=ranks, workers=-1)
        distance = distance.copy()
        for column, column_distance in zip(sites.T, site_distance.T, strict=True):
            rows = np.flatnonzero(column_distance < distance + reach)
            exact = triangle_distance(points[rows], self._corners[faces[column[rows]]])
            distance[rows] = np.minimum(distance[rows], exact)
        return distance, (site_distance[:, -1] >= distance + reach) | (last >= len(faces))

    @cached_property
    def _sites(self) -> tuple[cKDTree, np.ndarray, float]:
        """Sites of all faces in a tree, the face of each, and how far a face's points may lie from its sites."""
        frames = _BaseFrames.of(self._corners)
        counts = np.ceil(np.stack((frames.base, frames.height), axis=1) / _SITE_SPACING_M)
        counts = np.clip(counts, 1, _MOST_SITES_ALONG).astype(np.int64)
        if counts.prod(axis=1).sum() > max(_MOST_SITES, 2 * len(counts)):
            raise DatasetError(
                f"a mesh of {len(counts)} faces and {self.area_m2:.3g} m2 is too large to measure distances to; "
                "is it in meters?"
            )
        sites, owners = [], []
        for columns, rows in np.unique(counts, axis=0):
            faces = np.flatnonzero((counts == (columns, rows)).all(axis=1))
            sites.append(frames.sites(faces, columns, rows))
            owners.append(np.repeat(faces, columns * rows))
        reach = _REACH * min(_SITE_SPACING_M, float(frames.base.max()))
        return cKDTree(np.concatenate(sites)), np.concatenate(owners), reach


def triangle_distance(points: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """Distance [N] of each point [N,3] to its triangle [N,3,3] (corner, coordinate) of an area above 0."""
    a, b, c = np.moveaxis(corners, 1, 0)
    normal = np.cross(b - a, c - a)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    squared = np.full(len(points), np.inf)
    inside = np.ones(len(points), dtype=bool)
    for start, end in ((a, b), (b, c), (c, a)):
        edge, offset = end - start, points - start
        along = np.clip(_dot(offset, edge) / _dot(edge, edge), 0, 1)
        aside = offset - along[:, None] * edge
        np.minimum(squared, _dot(aside, aside), out=squared)
        inside &= _dot(np.cross(normal, edge), offset) >= 0
    return np.where(inside, np.abs(_dot(points - a, normal)), np.sqrt(squared))


@dataclass(frozen=True)
class _BaseFrames:
    """Triangles standing on their longest edge: its start and direction [N,3], its length, the upward direction [N,3],
    the height, and where along the base the top's foot is; lengths [N]."""

    start: np.ndarray
    along: np.ndarray
    base: np.ndarray
    up: np.ndarray
    height: np.ndarray
    foot: np.ndarray

    @classmethod
    def of(cls, corners: np.ndarray) -> _BaseFrames:
        lengths = np.linalg.norm(np.roll(corners, 1, axis=1) - np.roll(corners, 2, axis=1), axis=2)
        turned = (lengths.argmax(axis=1)[:, None] + np.arange(3)) % 3
        top, start, end = np.moveaxis(np.take_along_axis(corners, turned[:, :, None], axis=1), 1, 0)
        base = lengths.max(axis=1)
        along = (end - start) / base[:, None]
        # A right angle's foot is kept off the base's end, so that both sides of the roof have a slope.
        foot = np.clip(_dot(top - start, along), 1e-9 * base, (1 - 1e-9) * base)
        rise = top - start - foot[:, None] * along
        height = np.linalg.norm(rise, axis=1)
        return cls(start, along, base, rise / np.maximum(height, 1e-300)[:, None], height, foot)

    def sites(self, faces: np.ndarray, columns: int, rows: int) -> np.ndarray:
        """Points in each of some faces [M], spread over columns along the base and rows up to the roof."""
        base, height, foot = (values[faces, None] for values in (self.base, self.height, self.foot))
        x = base * (np.arange(columns) + 0.5) / columns
        roof = height * np.minimum(x / foot, (base - x) / (base - foot))
        y = roof[:, :, None] * (np.arange(rows) + 0.5) / rows
        start, along, up = (vectors[faces, None, None] for vectors in (self.start, self.along, self.up))
        return (start + x[:, :, None, None] * along + y[..., None] * up).reshape(-1, 3)


def _dot(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.einsum("ni,ni->n", a, b)
