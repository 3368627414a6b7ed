"""Conforming subdivision of a triangle mesh at chosen edges; the surface stays where it is."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch

from spslam.meshing.mesh import TriangleMesh


@dataclass(frozen=True)
class MeshEdges:
    """The edges of a mesh, each once; E of them, of L faces.

    Attributes:
        ends: int64 [E, 2], the vertices of each, the lower index first; in ascending order.
        of_faces: int64 [L, 3], the edges of each face: from its first corner to the second, to the third, and back.
    """

    ends: np.ndarray
    of_faces: np.ndarray


def mesh_edges(faces: np.ndarray, num_vertices: int, device: torch.device | str = "cpu") -> MeshEdges:
    """Finds the edges of faces.

    Args:
        faces: integers [L, 3].
        num_vertices: number of vertices that they index.
        device: where they are sorted.

    Returns:
        The edges; none for no face.
    """
    corners = torch.from_numpy(np.ascontiguousarray(faces)).to(device, torch.int64)
    following, base = corners[:, [1, 2, 0]], max(num_vertices, 1)
    keys = torch.minimum(corners, following) * base + torch.maximum(corners, following)
    unique, of_faces = torch.unique(keys, return_inverse=True)  # a third of NumPy's time
    ends = torch.stack([unique.div(base, rounding_mode="floor"), unique % base], dim=1)
    return MeshEdges(ends.cpu().numpy(), of_faces.cpu().numpy())


def midpoints(mesh: TriangleMesh, ends: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Points and normals, float32 [E, 3], halfway between vertices `ends` [E, 2]; colors are not looked at."""
    first, second = ends.T
    normals = mesh.normals[first] + mesh.normals[second]
    length = np.sqrt(np.einsum("ij,ij->i", normals, normals))[:, None]
    normals = np.divide(normals, length, out=np.zeros_like(normals), where=length > 0)
    return 0.5 * (mesh.vertices[first] + mesh.vertices[second]), normals


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
    faces, parents = _divided(mesh.faces.astype(np.int64), new[edges.of_faces], vertices)
    faces = faces[np.argsort(parents, kind="stable")].astype(np.int32)
    return TriangleMesh(vertices, faces, np.concatenate([mesh.colors, colors]), np.concatenate([mesh.normals, normals]))


def _divided(faces: np.ndarray, middles: np.ndarray, vertices: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The parts [N, 3] of faces [L, 3] whose edges have the middles [L, 3], -1 for none, and the face of each part."""
    count = (middles >= 0).sum(1)
    rows = [np.flatnonzero(count == number) for number in range(4)]
    # Corners and edges turned so that the only middle is on the first edge, and of two the third edge has none.
    one, one_middles = _turned(faces[rows[1]], middles[rows[1]], (middles[rows[1]] >= 0).argmax(1))
    two, two_middles = _turned(faces[rows[2]], middles[rows[2]], (middles[rows[2]] < 0).argmax(1) + 1)
    parts = [
        [faces[rows[0]]],
        _halves(one, one_middles[:, 0]),
        _thirds(two, two_middles[:, 0], two_middles[:, 1], vertices),
        _quarters(faces[rows[3]], middles[rows[3]]),
    ]
    of_parts = [np.tile(own, len(each)) for own, each in zip(rows, parts, strict=True)]
    return np.concatenate([face for each in parts for face in each]), np.concatenate(of_parts)


def _turned(faces: np.ndarray, middles: np.ndarray, first: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    order = (first[:, None] + np.arange(3)) % 3
    return np.take_along_axis(faces, order, axis=1), np.take_along_axis(middles, order, axis=1)


def _halves(faces: np.ndarray, middle: np.ndarray) -> list[np.ndarray]:
    a, b, c = faces.T
    return [np.stack([a, middle, c], axis=1), np.stack([middle, b, c], axis=1)]


def _thirds(faces: np.ndarray, ab: np.ndarray, bc: np.ndarray, vertices: np.ndarray) -> list[np.ndarray]:
    """A triangle at the corner between the two edges, and the rest divided along its shorter diagonal."""
    a, b, c = faces.T
    from_a, from_c = vertices[bc] - vertices[a], vertices[ab] - vertices[c]
    at_a = np.einsum("ij,ij->i", from_a, from_a) <= np.einsum("ij,ij->i", from_c, from_c)
    one, other = np.where(at_a, a, ab), np.where(at_a, bc, c)
    return [
        np.stack([ab, b, bc], axis=1),
        np.stack([a, ab, other], axis=1),
        np.stack([one, bc, c], axis=1),
    ]


def _quarters(faces: np.ndarray, middles: np.ndarray) -> list[np.ndarray]:
    (a, b, c), (ab, bc, ca) = faces.T, middles.T
    triples = (a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca)
    return [np.stack(triple, axis=1) for triple in triples]
