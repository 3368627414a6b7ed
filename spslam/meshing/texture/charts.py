"""Cuts a mesh into charts: connected parts of similar normal, each projected onto a plane.

Colors of a texture are those of points in space, so it does not show where charts border on each other; they need not
follow edges of the scene, nor be few.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from spslam.meshing.mesh import TriangleMesh, face_normals

# Faces are told apart by their normals, to which the same smoothed over so many rings is added: marching cubes are
# noisy, and at a crease the smoothed ones alone say nothing.
_SMOOTHED_RINGS = 4
# Charts of fewer faces join a neighbor, if its plane is not steeper to them than this cosine; rounds of that.
_SMALL_CHART, _LEAST_COSINE, _ROUNDS = 40, 0.2, 4
# Faces that cover one cell, of so many mean edges, more than so many edges apart lie over each other. Such a chart is
# cut into slabs, at first so thick, then by half.
_CELL_EDGES, _APART_EDGES, _SLAB_EDGES, _CUTS = 2.0, 7.0, 32.0, 4
# Normals that count for one of the three axes that most surface is square to, and those that are looked at.
_ALONG, _SAMPLED = 0.95, 500
# Where all normals are along the first axis the second is a mixture of its coordinates; what of this is square to the
# first may be nothing but rounding, as where these are equal.
_PARALLEL = 1e-3


@dataclass(frozen=True)
class Charts:
    """Charts of a mesh; C of them, with K corners of L faces. A vertex on the border of two is a corner of each.

    Attributes:
        of_faces: int64 [L], the chart of each face.
        vertices: int64 [K], the mesh's vertex that each corner is.
        faces: int32 [L, 3], indices of corners.
        places_m: float32 [K, 2], corners in the plane of their chart, m, from 0.
        sizes_m: float32 [C, 2], extents of the charts, m.
    """

    of_faces: np.ndarray
    vertices: np.ndarray
    faces: np.ndarray
    places_m: np.ndarray
    sizes_m: np.ndarray


def make_charts(mesh: TriangleMesh, tile_m: float) -> Charts:
    """Cuts a mesh into charts.

    Args:
        mesh: with at least one face.
        tile_m: charts are cut at squares of this size in their plane, m, so that they can be packed.

    Returns:
        The charts. Deterministic. Two faces of a chart may cover the same place only where a wrinkle of some edges'
        height folds over.
    """
    normals = _smoothed_normals(mesh)
    pairs = _neighbors(mesh.faces)
    axes = _main_axes(normals, np.linalg.norm(face_normals(mesh.vertices, mesh.faces), axis=1))
    across = normals @ axes.T
    sides = np.concatenate([across, -across], axis=1).argmax(1)
    directions = np.concatenate([axes, -axes])
    charts = _components(sides, pairs)
    for _ in range(_ROUNDS):
        sides, changed = _joined(sides, charts, pairs, normals @ directions.T)
        charts = _components(sides, pairs)
        if not changed:
            break
    centers = mesh.vertices[mesh.faces].mean(1, dtype=np.float64)
    edge_m = float(np.linalg.norm(mesh.vertices[mesh.faces[:, 1]] - mesh.vertices[mesh.faces[:, 0]], axis=1).mean())
    bases = _bases(charts, sides, normals, axes)
    for cut in range(_CUTS):
        folded = _folded(charts, bases, centers, edge_m)
        if not folded.any():
            break
        height = _dot(bases[charts, 2], centers)
        slab = np.where(folded[charts], np.floor(height / (_SLAB_EDGES * edge_m / 2**cut)), 0).astype(np.int64)
        charts = _components(_numbered(charts, slab), pairs)
        bases = _bases(charts, sides, normals, axes)
    return _projected(mesh, charts, bases, centers, tile_m)


def _smoothed_normals(mesh: TriangleMesh) -> np.ndarray:
    """Normals float32 [L, 3] of the faces, smoothed over rings of them; own ones added."""
    from scipy.sparse import csr_matrix

    count = len(mesh.faces)
    ends = np.arange(0, 3 * count + 1, 3)
    corners = csr_matrix((np.ones(3 * count, np.float32), mesh.faces.ravel(), ends), (count, len(mesh.vertices)))
    normals = face_normals(mesh.vertices, mesh.faces).astype(np.float32)
    own = _unit(normals)
    vertices_of = corners.T.tocsr()
    for _ in range(_SMOOTHED_RINGS):
        normals = _unit(corners @ (vertices_of @ normals))
    return _unit(normals + own)


def _neighbors(faces: np.ndarray) -> np.ndarray:
    """Pairs int64 [P, 2] of faces with a common edge."""
    first, second = faces, faces[:, [1, 2, 0]]
    low, high = np.minimum(first, second).astype(np.int64), np.maximum(first, second)
    keys = (low * (int(faces.max()) + 1) + high).ravel()
    order = np.argsort(keys, kind="stable")
    same = np.flatnonzero(keys[order[1:]] == keys[order[:-1]])
    return np.stack([order[same], order[same + 1]], axis=1) // 3


def _main_axes(normals: np.ndarray, areas: np.ndarray) -> np.ndarray:
    """Three orthogonal unit axes float32 [3, 3], rows, along the normals that most area has."""
    picked = normals[:: max(len(normals) // (10 * _SAMPLED), 1)]
    weights = areas[:: max(len(normals) // (10 * _SAMPLED), 1)]
    candidates = picked[:: max(len(picked) // _SAMPLED, 1)]
    votes = (np.abs(candidates @ picked.T) > _ALONG) @ weights
    first = candidates[votes.argmax()]
    level = np.abs(candidates @ first) < np.sqrt(1 - _ALONG**2)
    second = candidates[np.where(level, votes, -1).argmax()] if level.any() else np.roll(first, 1) + np.float32(0.1)
    second = second - first * float(second @ first)
    if np.linalg.norm(second) < _PARALLEL:
        second = np.eye(3, dtype=np.float32)[np.abs(first).argmin()]
        second = second - first * float(second @ first)
    second = second / np.linalg.norm(second)
    return np.stack([first, second, np.cross(first, second)]).astype(np.float32)


def _components(keys: np.ndarray, pairs: np.ndarray) -> np.ndarray:
    """Numbers int64 [L] of connected parts of faces with the same key, in order of their first face."""
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    same = pairs[keys[pairs[:, 0]] == keys[pairs[:, 1]]]
    graph = coo_matrix((np.ones(len(same), bool), (same[:, 0], same[:, 1])), (len(keys), len(keys)))
    return connected_components(graph, directed=False)[1].astype(np.int64)


def _joined(sides: np.ndarray, charts: np.ndarray, pairs: np.ndarray, cosines: np.ndarray) -> tuple[np.ndarray, bool]:
    """Sides of the faces after small charts took that of most of their neighbors, and whether any did."""
    count = int(charts.max()) + 1
    sizes = np.bincount(charts, minlength=count)
    ways = np.concatenate([pairs, pairs[:, ::-1]])
    ways = ways[sides[ways[:, 0]] != sides[ways[:, 1]]]
    ways = ways[(sizes[charts[ways[:, 0]]] < _SMALL_CHART) & (sizes[charts[ways[:, 1]]] > sizes[charts[ways[:, 0]]])]
    kinds = cosines.shape[1]
    votes = np.bincount(charts[ways[:, 0]] * kinds + sides[ways[:, 1]], minlength=count * kinds).reshape(count, kinds)
    facing = np.stack([np.bincount(charts, cosines[:, kind], count) for kind in range(kinds)], axis=1)
    votes = np.where(facing >= _LEAST_COSINE * sizes[:, None], votes, 0)
    taken = np.where(votes.max(1) > 0, votes.argmax(1), -1)[charts]
    return np.where(taken >= 0, taken, sides), bool((taken >= 0).any())


def _bases(charts: np.ndarray, sides: np.ndarray, normals: np.ndarray, axes: np.ndarray) -> np.ndarray:
    """Two axes in the plane of each chart and its normal, float64 [C, 3, 3], rows."""
    count = int(charts.max()) + 1
    normal = _unit(np.stack([np.bincount(charts, normals[:, axis], count) for axis in range(3)], axis=1))
    first = np.zeros(count, np.int64)
    first[charts[::-1]] = np.arange(len(charts))[::-1]
    level = axes[(sides[first] + 1) % 3].astype(np.float64)
    x = _unit(level - normal * _dot(level, normal)[:, None])
    return np.stack([x, np.cross(normal, x), normal], axis=1)


def _folded(charts: np.ndarray, bases: np.ndarray, centers: np.ndarray, edge_m: float) -> np.ndarray:
    """Bool [C]: charts in whose plane faces lie over others."""
    x, y, height = (_dot(bases[charts, axis], centers) for axis in range(3))
    cell = _CELL_EDGES * edge_m
    keys = _numbered(charts, np.floor(x / cell).astype(np.int64), np.floor(y / cell).astype(np.int64))
    order = np.argsort(keys, kind="stable")
    starts = np.flatnonzero(np.diff(keys[order], prepend=-1))
    apart = np.maximum.reduceat(height[order], starts) - np.minimum.reduceat(height[order], starts)
    folded = np.zeros(int(charts.max()) + 1, bool)
    folded[charts[order[starts]][apart > _APART_EDGES * edge_m]] = True
    return folded


def _numbered(*keys: np.ndarray) -> np.ndarray:
    """One number int64 [N] for each combination of whole numbers."""
    total = keys[0]
    for key in keys[1:]:
        low = int(key.min())
        total = total * (int(key.max()) - low + 1) + (key - low)
        total = np.unique(total, return_inverse=True)[1].reshape(-1)
    return total


def _projected(mesh: TriangleMesh, charts: np.ndarray, bases: np.ndarray, centers: np.ndarray, tile_m: float) -> Charts:
    tiles = [np.floor(_dot(bases[charts, axis], centers) / tile_m).astype(np.int64) for axis in range(2)]
    cut = _numbered(charts, *tiles)
    base_of = np.zeros(int(cut.max()) + 1, np.int64)
    base_of[cut] = charts
    keys = (cut[:, None] * len(mesh.vertices) + mesh.faces).ravel()
    found, faces = np.unique(keys, return_inverse=True)
    owner, vertices = np.divmod(found, len(mesh.vertices))
    points = mesh.vertices[vertices].astype(np.float64)
    places = np.stack([_dot(bases[base_of[owner], axis], points) for axis in range(2)], axis=1)
    starts = np.flatnonzero(np.diff(owner, prepend=-1))
    least = np.minimum.reduceat(places, starts)
    places -= least[owner]
    sizes = np.maximum.reduceat(places, starts)
    return Charts(cut, vertices, faces.reshape(-1, 3).astype(np.int32), places.astype(np.float32), sizes)


def _unit(vectors: np.ndarray) -> np.ndarray:
    return vectors / np.maximum(np.linalg.norm(vectors, axis=1, keepdims=True), 1e-20)


def _dot(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    return np.einsum("ij,ij->i", a, b)
