"""Conforming subdivision of a triangle mesh at chosen edges; the surface stays where it is."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from spslam.image_library import check_memory, image_library
from spslam.meshing.mesh import TriangleMesh, indexed


@dataclass(frozen=True)
class MeshEdges:
    """The edges of a mesh, each once; E of them, of L faces.

    Attributes:
        ends: int64 [E, 2], the vertices of each, the lower index first; in ascending order.
        of_faces: int64 [L, 3], the edges of each face: from its first corner to the second, to the third, and back.
    """

    ends: np.ndarray
    of_faces: np.ndarray


def mesh_edges(faces: np.ndarray, num_vertices: int) -> MeshEdges:
    """Finds the edges of faces.

    Args:
        faces: integers [L, 3].
        num_vertices: number of vertices that they index.

    Returns:
        The edges; none for no face.

    Raises:
        ValueError: a face of other indices than those of vertices.
        MemoryError: there is not enough.
    """
    faces = indexed(faces, num_vertices)
    ends, of_faces = np.empty((3 * len(faces), 2), np.int64), np.empty((len(faces), 3), np.int64)
    count = check_memory(
        image_library().spslam_mesh_edges(
            faces.ctypes.data, len(faces), num_vertices, ends.ctypes.data, of_faces.ctypes.data
        )
    )
    return MeshEdges(ends[:count].copy(), of_faces)


def midpoints(mesh: TriangleMesh, ends: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Points and normals, float32 [E, 3], halfway between vertices `ends` [E, 2]; colors are not looked at."""
    ends = np.ascontiguousarray(ends, np.int64)
    if ends.size and not 0 <= ends.min() <= ends.max() < len(mesh.vertices):
        raise ValueError(f"ends must be {len(mesh.vertices)} vertices, got {ends.min()}, {ends.max()}")
    vertices, normals = (np.ascontiguousarray(each) for each in (mesh.vertices, mesh.normals))
    middles, middle_normals = (np.empty((len(ends), 3), np.float32) for _ in range(2))
    image_library().spslam_edge_middles(
        len(ends),
        ends.ctypes.data,
        vertices.ctypes.data,
        normals.ctypes.data,
        middles.ctypes.data,
        middle_normals.ctypes.data,
    )
    return middles, middle_normals


def split_edges(mesh: TriangleMesh, edges: MeshEdges, chosen: np.ndarray, colors: np.ndarray) -> TriangleMesh:
    """Puts a vertex in the middle of each chosen edge, and divides the faces at it.

    A face with one such edge becomes two faces, with two three, with three four ("green" and "red" refinement, Bank,
    Sherman and Weiser 1983). As both faces at an edge take its middle, the mesh has no cracks or T-junctions, and as
    the new faces lie in the plane of the old one, the surface is the same to rounding.

    Args:
        mesh: to be divided. Not changed.
        edges: of its faces, see `mesh_edges`.
        chosen: int64 [M], rows of `edges`, ascending.
        colors: uint8 [M, 3] of the new vertices.

    Returns:
        The mesh: first its vertices as they were, then the middles in the order of `chosen`; faces in the order of
        those that they are parts of. Deterministic.
    """
    new = np.full(len(edges.ends), -1, np.int64)
    new[chosen] = len(mesh.vertices) + np.arange(len(chosen))
    middles, normals = midpoints(mesh, edges.ends[chosen])
    vertices = np.concatenate([mesh.vertices, middles])
    faces = _divided(mesh.faces, new[edges.of_faces], vertices)
    return TriangleMesh(vertices, faces, np.concatenate([mesh.colors, colors]), np.concatenate([mesh.normals, normals]))


def _divided(faces: np.ndarray, middles: np.ndarray, vertices: np.ndarray) -> np.ndarray:
    """The parts int32 [N, 3] of faces [L, 3] whose edges have the middles int64 [L, 3], -1 for none."""
    faces = indexed(faces, len(vertices))
    parts = np.empty((len(faces) + np.count_nonzero(middles >= 0), 3), np.int32)
    image_library().spslam_divide_faces(
        faces.ctypes.data, len(faces), len(vertices), middles.ctypes.data, vertices.ctypes.data, parts.ctypes.data
    )
    return parts
