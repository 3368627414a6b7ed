"""Surfaces to sample points on and to measure distances to; triangle meshes as such surfaces."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Protocol

import numpy as np
from scipy.spatial import cKDTree

from spslam.errors import DatasetError
from spslam.meshing import load_mesh

# Nearest faces are found by sites: points spread over each face at about this spacing, or one if it is smaller. No
# point of a face is farther from its nearest site than 1.1 times the spacing, or the face's longest edge.
_SITE_SPACING_M = 0.02
_REACH = 1.1
# Small faces would hide large ones behind hundreds of their sites, so faces are searched by size, each so many times
# larger than the one before.
_SIZE_RATIO, _SIZES = 2.0, 6
# A face that would have more sites, such as one of 10 by 10 m, has none: it is compared with each point.
_MOST_SITES_OF_FACE = 1 << 18
# Of all faces together, unless there are as many faces: 2,500 m2. They take a quarter of a gigabyte and some seconds.
_MOST_SITES = 1 << 23
# Number of nearest sites compared in each round, until the nearest face is certain. Where it is not, points that are no
# farther than this from the surface are compared with all faces that may be nearest.
_SITES_COMPARED = (8, 32, 128)
_EXACT_M = 0.1
# Pairs of a point and a face that are then compared at once; some 500 bytes each.
_PAIRS = 1 << 17


class Surface(Protocol):
    """Interface of a surface for the metrics; lengths in meters."""

    def sample_surface(self, count: int, seed: int = 0) -> np.ndarray:
        """Points [count, 3] sampled uniformly by area; the same for the same count and seed."""

    def distance(self, points: np.ndarray) -> np.ndarray:
        """Distances [N] of points [N, 3] to the surface; infinite if it is empty."""

    def triangles(self) -> tuple[np.ndarray, np.ndarray]:
        """Vertices [V, 3] and faces [L, 3] to render it with."""


class TriangleSurface:
    """A triangle mesh in any order, orientation and connectivity.

    Args:
        vertices: [V, 3], meters, finite.
        faces: [F, 3], indices of vertices.

    Raises:
        ValueError: another shape, or an index out of range.
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
        """Reads a mesh file; raises DatasetError as `spslam.meshing.load_mesh` does, and for a mesh without area."""
        mesh = load_mesh(path)
        if not len(mesh.faces):
            raise DatasetError(f"{path}: must be a mesh with faces, got none")
        surface = cls(mesh.vertices, mesh.faces)
        if not len(surface._faces):
            raise DatasetError(f"{path}: must be a mesh with an area, but none of {len(mesh.faces)} faces has one")
        return surface

    def triangles(self) -> tuple[np.ndarray, np.ndarray]:
        """Vertices [V, 3] and faces [L, 3], without faces of zero area."""
        return self._vertices, self._faces

    def sample_surface(self, count: int, seed: int = 0) -> np.ndarray:
        """Samples points uniformly by area, float64 [count, 3]; [0, 3] for a mesh without area.

        Faces are drawn by stratified sampling of the cumulative area, so that any run of faces gets its share of the
        points to within one point. Positions in a face are uniform. The same input gives the same points.
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
        """Distances [N] in meters of points [N, 3] to the nearest triangle; infinite for a mesh without area.

        The nearest sites of a point give the candidate faces: as many sites as needed to be certain that no other face
        is nearer, but of points 10 cm away and more at most 128 of faces of about the same size. So the distance is
        exact up to 10 cm from the surface; farther away it may be a few millimeters too large. Deterministic. Raises
        DatasetError for a surface of thousands of square meters.
        """
        points = np.asarray(points, dtype=np.float64).reshape(-1, 3)
        distance = np.full(len(points), np.inf)
        if not len(self._corners) or not len(points):
            return distance
        large, sites_by_size = self._sites
        for face in large:
            corners = np.broadcast_to(self._corners[face], (len(points), 3, 3))
            np.minimum(distance, triangle_distance(points, corners), out=distance)
        for sites in sites_by_size:
            self._compare(sites, points, distance)
        return distance

    def _compare(self, sites: _Sites, points: np.ndarray, distance: np.ndarray) -> None:
        """Lowers distances [N], in place, to those to the faces of sites."""
        unsettled, compared = np.arange(len(points)), 0
        for count in _SITES_COMPARED:
            found, settled = self._nearest_among(sites, points[unsettled], distance[unsettled], (compared, count))
            distance[unsettled] = found
            unsettled, compared = unsettled[~settled], count
        near = unsettled[distance[unsettled] < _EXACT_M + sites.reach]
        lengths = sites.tree.query_ball_point(
            points[near], distance[near] + sites.reach, workers=-1, return_length=True
        )
        for rows in np.split(near, np.flatnonzero(np.diff(np.cumsum(lengths) // _PAIRS)) + 1):
            self._compare_within_reach(sites, points, distance, rows)

    def _nearest_among(
        self, sites: _Sites, points: np.ndarray, distance: np.ndarray, ranks: tuple[int, int]
    ) -> tuple[np.ndarray, np.ndarray]:
        """Distances by the faces of the nearest sites within these ranks too; returns which are certain."""
        first, last = ranks
        wanted = np.arange(first + 1, min(last, len(sites.faces)) + 1)
        if not len(points) or not len(wanted):
            return distance, np.ones(len(points), dtype=bool)
        site_distance, nearest = sites.tree.query(points, k=wanted, workers=-1)
        distance = distance.copy()
        for column, column_distance in zip(nearest.T, site_distance.T, strict=True):
            rows = np.flatnonzero(column_distance < distance + sites.reach)
            exact = triangle_distance(points[rows], self._corners[sites.faces[column[rows]]])
            distance[rows] = np.minimum(distance[rows], exact)
        return distance, (site_distance[:, -1] >= distance + sites.reach) | (last >= len(sites.faces))

    def _compare_within_reach(self, sites: _Sites, points: np.ndarray, distance: np.ndarray, rows: np.ndarray) -> None:
        """Lowers distances in `rows`, in place, to those to all faces of sites that may be nearer."""
        within = sites.tree.query_ball_point(points[rows], distance[rows] + sites.reach, workers=-1)
        rows = np.repeat(rows, [len(each) for each in within])
        faces = sites.faces[np.concatenate([np.asarray(each, dtype=np.int64) for each in [*within, []]])]
        for first in range(0, len(rows), _PAIRS):
            part = slice(first, first + _PAIRS)
            np.minimum.at(distance, rows[part], triangle_distance(points[rows[part]], self._corners[faces[part]]))

    @cached_property
    def _sites(self) -> tuple[np.ndarray, list[_Sites]]:
        """Faces that have no sites, as they would have too many, and the sites of all others by their size."""
        frames = _BaseFrames.of(self._corners)
        counts = np.ceil(np.stack((frames.base, frames.height), axis=1) / _SITE_SPACING_M).clip(1, 1 << 30)
        counts = counts.astype(np.int64)
        of_faces = counts.prod(axis=1)
        if of_faces.clip(max=_MOST_SITES_OF_FACE).sum() > max(_MOST_SITES, 2 * len(counts)):
            raise DatasetError(
                f"a mesh of {len(counts)} faces and {self._areas.sum():.3g} m2 is too large to measure distances to; "
                "is it in meters?"
            )
        reach = _REACH * np.minimum(_SITE_SPACING_M, frames.base)
        sizes = np.ceil(np.log(reach / (_REACH * _SITE_SPACING_M)) / np.log(_SIZE_RATIO)).clip(-_SIZES + 1, 0)
        is_large = of_faces > _MOST_SITES_OF_FACE
        by_size = [np.flatnonzero((sizes == size) & ~is_large) for size in range(0, -_SIZES, -1)]
        sites = [_Sites.of(frames, counts, faces, float(reach[faces].max())) for faces in by_size if len(faces)]
        return np.flatnonzero(is_large), sites


def triangle_distance(points: np.ndarray, corners: np.ndarray) -> np.ndarray:
    """Distance [N] of each point [N, 3] to its triangle [N, 3, 3] (corner, coordinate), which must have an area > 0."""
    a, b, c = np.moveaxis(corners, 1, 0)
    normal = np.cross(b - a, c - a)
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    squared = np.full(len(points), np.inf)
    inside = np.ones(len(points), dtype=bool)
    for start, end in ((a, b), (b, c), (c, a)):
        edge, offset = end - start, points - start
        along = np.clip(_dot(offset, edge) / _dot(edge, edge), 0, 1)
        to_edge = offset - along[:, None] * edge
        np.minimum(squared, _dot(to_edge, to_edge), out=squared)
        inside &= _dot(np.cross(normal, edge), offset) >= 0
    return np.where(inside, np.abs(_dot(points - a, normal)), np.sqrt(squared))


@dataclass(frozen=True)
class _BaseFrames:
    """Coordinate frames of triangles with the longest edge as base.

    Attributes:
        start: [N, 3], start of the base.
        along: [N, 3], unit direction of the base.
        base: [N], length of the base.
        up: [N, 3], unit direction of the height.
        height: [N].
        foot: [N], position of the foot of the height along the base.
    """

    start: np.ndarray
    along: np.ndarray
    base: np.ndarray
    up: np.ndarray
    height: np.ndarray
    foot: np.ndarray

    @classmethod
    def of(cls, corners: np.ndarray) -> _BaseFrames:
        lengths = np.linalg.norm(np.roll(corners, 1, axis=1) - np.roll(corners, 2, axis=1), axis=2)
        order = (lengths.argmax(axis=1)[:, None] + np.arange(3)) % 3
        top, start, end = np.moveaxis(np.take_along_axis(corners, order[:, :, None], axis=1), 1, 0)
        base = lengths.max(axis=1)
        along = (end - start) / base[:, None]
        # The foot is kept off the ends of the base, so that both other sides have a finite slope.
        foot = np.clip(_dot(top - start, along), 1e-9 * base, (1 - 1e-9) * base)
        rise = top - start - foot[:, None] * along
        height = np.linalg.norm(rise, axis=1)
        return cls(start, along, base, rise / np.maximum(height, 1e-300)[:, None], height, foot)

    def sites(self, faces: np.ndarray, columns: int, rows: int) -> np.ndarray:
        """Sites in given faces [M], on a grid of columns along the base and rows up to the other two sides."""
        base, height, foot = (values[faces, None] for values in (self.base, self.height, self.foot))
        x = base * (np.arange(columns) + 0.5) / columns
        top = height * np.minimum(x / foot, (base - x) / (base - foot))
        y = top[:, :, None] * (np.arange(rows) + 0.5) / rows
        start, along, up = (vectors[faces, None, None] for vectors in (self.start, self.along, self.up))
        return (start + x[:, :, None, None] * along + y[..., None] * up).reshape(-1, 3)


@dataclass(frozen=True)
class _Sites:
    """Sites of faces of about the same size.

    Attributes:
        tree: k-d tree of the sites.
        faces: int64 [S], the face of each.
        reach: the largest distance of a point of a face to its nearest site, m.
    """

    tree: cKDTree
    faces: np.ndarray
    reach: float

    @classmethod
    def of(cls, frames: _BaseFrames, counts: np.ndarray, faces: np.ndarray, reach: float) -> _Sites:
        """Sites of the given faces [M] by the numbers of columns and rows [F, 2] of all."""
        sites, owners = [], []
        for columns, rows in np.unique(counts[faces], axis=0):
            chosen = faces[(counts[faces] == (columns, rows)).all(axis=1)]
            sites.append(frames.sites(chosen, columns, rows))
            owners.append(np.repeat(chosen, columns * rows))
        # Of millions of sites a balanced tree takes three times as long to build, and no less to query.
        tree = cKDTree(np.concatenate(sites), compact_nodes=False, balanced_tree=False)
        return cls(tree, np.concatenate(owners), reach)


def _dot(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.einsum("ni,ni->n", a, b)
