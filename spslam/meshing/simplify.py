"""Simplifies a mesh by vertex clustering, for pages and viewers that a full mesh is too large for."""

from __future__ import annotations

import numpy as np

from spslam.meshing.load import Mesh

# Of a first guess at the cell; each further round scales the cell by the faces that were left.
_MAX_ROUNDS = 12
# Cells per axis: three indices of 20 bits each make one key of 64 bits.
_MAX_CELLS = 1 << 20


def simplify_mesh(mesh: Mesh, max_faces: int) -> Mesh:
    """Simplifies a mesh by vertex clustering (Rossignac and Borrel 1993) until it has few enough faces.

    The vertices of each cell of a cubic grid become one vertex with their mean position and mean color; faces with two
    corners in one cell vanish. Unlike decimation by error quadrics it keeps vertices in plane surface, where colors,
    which are stored at vertices, may differ.

    Args:
        mesh: the mesh; one with few enough faces is returned as it is.
        max_faces: largest number of faces of the result, at least 1.

    Returns:
        The simplified mesh; vertices without a face are left out. Deterministic; 1.7 million faces take a second.

    Raises:
        ValueError: `max_faces` is below 1.
    """
    if max_faces < 1:
        raise ValueError(f"simplify_mesh: max_faces must be at least 1, got {max_faces}")
    if len(mesh.faces) <= max_faces:
        return mesh
    extent_m = float(np.ptp(mesh.vertices, axis=0).max())
    # A surface of small triangles has two of them per square of a cell's size.
    cell_m = max(np.sqrt(2 * _area(mesh) / max_faces), extent_m / _MAX_CELLS, 1e-9)
    finer = mesh
    for _ in range(_MAX_ROUNDS):
        simple = cluster_vertices(mesh, cell_m)
        if not len(simple.faces):
            break
        if len(simple.faces) <= max_faces:
            return simple
        finer = simple
        cell_m *= np.sqrt(len(simple.faces) / max_faces) * 1.02
    # No cell suits parts of few faces that are far from each other: the largest faces are what is seen.
    return _largest_faces(finer, max_faces)


def cluster_vertices(mesh: Mesh, cell_m: float) -> Mesh:
    """Replaces the vertices in each cell of a cubic grid by one vertex with their mean position and mean color.

    Args:
        mesh: the mesh.
        cell_m: edge of a cell, in meters, above 0.

    Returns:
        The mesh without degenerate and repeated faces, and without vertices that no face has.
    """
    low = mesh.vertices.min(axis=0)
    cells = np.minimum(np.floor((mesh.vertices - low) / cell_m), _MAX_CELLS - 1).astype(np.int64)
    keys = (cells[:, 0] * _MAX_CELLS + cells[:, 1]) * _MAX_CELLS + cells[:, 2]
    found, cluster, sizes = np.unique(keys, return_inverse=True, return_counts=True)
    cluster = cluster.reshape(-1)
    vertices = np.stack([np.bincount(cluster, axis, len(found)) for axis in mesh.vertices.T], axis=1) / sizes[:, None]
    colors = np.stack([np.bincount(cluster, channel, len(found)) for channel in mesh.colors.T], axis=1)
    colors = np.rint(colors / sizes[:, None]).astype(np.uint8)
    return _used(Mesh(vertices, _distinct_faces(cluster[mesh.faces]), colors))


def _distinct_faces(faces: np.ndarray) -> np.ndarray:
    """The faces with three different corners, each once, in order; a face and its reverse are two."""
    a, b, c = faces.T
    faces = faces[(a != b) & (b != c) & (c != a)]
    # The smallest corner first, which leaves the orientation.
    first = np.argmin(faces, axis=1)
    turned = np.take_along_axis(faces, (first[:, None] + np.arange(3)) % 3, axis=1)
    order = np.lexsort(turned.T)
    is_first = np.ones(len(order), dtype=bool)
    is_first[1:] = (np.diff(turned[order], axis=0) != 0).any(axis=1)
    return turned[np.sort(order[is_first])]


def _used(mesh: Mesh) -> Mesh:
    used, faces = np.unique(mesh.faces, return_inverse=True)
    return Mesh(mesh.vertices[used], faces.reshape(-1, 3), mesh.colors[used])


def _largest_faces(mesh: Mesh, count: int) -> Mesh:
    order = np.argsort(-_face_areas(mesh), kind="stable")[:count]
    return _used(Mesh(mesh.vertices, mesh.faces[np.sort(order)], mesh.colors))


def _area(mesh: Mesh) -> float:
    return float(_face_areas(mesh).sum())


def _face_areas(mesh: Mesh) -> np.ndarray:
    a, b, c = (mesh.vertices[mesh.faces[:, corner]] for corner in range(3))
    return 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1)
