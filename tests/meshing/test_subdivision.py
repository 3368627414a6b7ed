"""Subdivision at chosen edges: no cracks, the same surface, against a plain reference."""

import numpy as np
import pytest

from spslam.meshing import TriangleMesh
from spslam.meshing.mesh import face_normals, vertex_normals
from spslam.meshing.subdivision import mesh_edges, midpoints, split_edges


def blob(seed=0):
    """A closed surface of 320 faces that are not in a plane: an icosahedron divided twice and dented."""
    golden = (1 + 5**0.5) / 2
    vertices = np.array([(0, i, j * golden) for i in (-1, 1) for j in (-1, 1)], float)
    vertices = np.concatenate([np.roll(vertices, turn, axis=1) for turn in range(3)])
    near = np.linalg.norm(vertices[:, None] - vertices, axis=2) < 2.1
    faces = [
        (a, b, c) if np.linalg.det(vertices[[a, b, c]]) > 0 else (a, c, b)
        for a in range(12)
        for b in range(a + 1, 12)
        for c in range(b + 1, 12)
        if near[a, b] and near[b, c] and near[c, a]
    ]
    mesh = mesh_of(vertices, np.array(faces))
    for _ in range(2):
        edges = mesh_edges(mesh.faces, len(mesh.vertices))
        rows = np.arange(len(edges.ends))
        mesh = split_edges(mesh, edges, rows, np.zeros((len(rows), 3), np.uint8))
    dents = np.random.default_rng(seed).uniform(0.8, 1.2, (len(mesh.vertices), 1))
    return mesh_of(mesh.vertices / np.linalg.norm(mesh.vertices, axis=1, keepdims=True) * dents, mesh.faces)


def mesh_of(vertices, faces):
    vertices, faces = vertices.astype(np.float32), faces.astype(np.int32)
    return TriangleMesh(vertices, faces, np.zeros(vertices.shape, np.uint8), vertex_normals(vertices, faces))


def split_some(mesh, share, seed=1):
    edges = mesh_edges(mesh.faces, len(mesh.vertices))
    chosen = np.flatnonzero(np.random.default_rng(seed).random(len(edges.ends)) < share)
    colors = np.random.default_rng(seed).integers(0, 256, (len(chosen), 3)).astype(np.uint8)
    return edges, chosen, colors, split_edges(mesh, edges, chosen, colors)


def test_each_edge_is_found_once():
    mesh = blob()
    edges = mesh_edges(mesh.faces, len(mesh.vertices))
    wanted = sorted({tuple(sorted((face[i], face[(i + 1) % 3]))) for face in mesh.faces.tolist() for i in range(3)})
    assert edges.ends.tolist() == [list(ends) for ends in wanted]
    for face, own in zip(mesh.faces.tolist(), edges.of_faces.tolist(), strict=True):
        assert [wanted[edge] for edge in own] == [tuple(sorted((face[i], face[(i + 1) % 3]))) for i in range(3)]


@pytest.mark.parametrize("share", [0.0, 0.1, 0.5, 0.9, 1.0])
def test_there_are_no_cracks(share):
    """Each edge of the closed surface is used twice, once in each direction, so no vertex lies inside an edge."""
    mesh = blob()
    edges, chosen, colors, divided = split_some(mesh, share)
    directed = np.concatenate([divided.faces[:, [0, 1]], divided.faces[:, [1, 2]], divided.faces[:, [2, 0]]])
    assert len(np.unique(directed, axis=0)) == len(directed)
    assert {tuple(each) for each in directed.tolist()} == {tuple(each[::-1]) for each in directed.tolist()}
    euler = len(divided.vertices) - len(directed) // 2 + len(divided.faces)
    assert euler == 2 == len(mesh.vertices) - len(edges.ends) + len(mesh.faces)
    assert np.array_equal(divided.colors[len(mesh.vertices) :], colors)
    assert len(divided.vertices) == len(mesh.vertices) + len(chosen)


def parts_of(face, split):
    """The areas and centers of what a face may become, by a plain loop over the two ways to divide a quadrilateral."""
    a, b, c = face
    middles = [(face[i] + face[(i + 1) % 3]) / 2 if split[i] else None for i in range(3)]
    corners = [point for i in range(3) for point in (face[i], middles[i]) if point is not None]
    assert len(corners) == 3 + sum(split)
    return 0.5 * np.linalg.norm(np.cross(b - a, c - a)), corners


@pytest.mark.parametrize("share", [0.3, 1.0])
def test_parts_cover_their_face_and_no_more(share):
    mesh = blob()
    edges, chosen, _, divided = split_some(mesh, share)
    is_chosen = np.isin(np.arange(len(edges.ends)), chosen)
    first = 0
    for face, own in zip(mesh.faces, edges.of_faces, strict=True):
        area, corners = parts_of(mesh.vertices[face].astype(np.float64), is_chosen[own])
        parts = divided.vertices[divided.faces[first : first + 1 + is_chosen[own].sum()]].astype(np.float64)
        first += len(parts)
        normals = np.cross(parts[:, 1] - parts[:, 0], parts[:, 2] - parts[:, 0])
        areas = 0.5 * np.linalg.norm(normals, axis=1)
        assert areas.sum() == pytest.approx(area, rel=1e-5) and areas.min() > 0.1 * area
        upright = face_normals(mesh.vertices, face[None])[0]
        assert (normals @ upright > 0).all()
        apart = np.linalg.norm(parts.reshape(-1, 1, 3) - np.array(corners), axis=2)
        assert apart.min(1).max() < 1e-6 and apart.min(0).max() < 1e-6
    assert first == len(divided.faces)


def test_a_quadrilateral_is_divided_along_its_shorter_diagonal():
    vertices = np.array([(0, 0, 0), (4, 0, 0), (0, 1, 0)])
    mesh = mesh_of(vertices, np.array([(0, 1, 2)]))
    edges = mesh_edges(mesh.faces, 3)
    rows = np.array([row for row, ends in enumerate(edges.ends.tolist()) if ends in ([0, 1], [1, 2])])
    divided = split_edges(mesh, edges, rows, np.zeros((2, 3), np.uint8))
    longest = np.linalg.norm(divided.vertices[divided.faces] - divided.vertices[np.roll(divided.faces, 1, 1)], axis=2)
    assert longest.max() < 2.1  # the other diagonal is as long, 2.06; both halves of the first edge are 2
    assert len(divided.faces) == 3


def test_normals_of_middles_are_unit_vectors_or_none():
    mesh = blob()
    points, normals = midpoints(mesh, mesh_edges(mesh.faces, len(mesh.vertices)).ends)
    assert np.allclose(np.linalg.norm(normals, axis=1), 1, atol=1e-5) and points.dtype == normals.dtype == np.float32
    none, normals = np.zeros((0, 3), np.int32), np.float32([[0, 0, 1], [0, 0, -1]])
    opposite = TriangleMesh(mesh.vertices[:2], none, mesh.colors[:2], normals)
    assert (midpoints(opposite, np.array([[0, 1]]))[1] == 0).all()


def test_a_mesh_without_faces_stays_as_it_is():
    mesh = mesh_of(np.zeros((0, 3)), np.zeros((0, 3)))
    edges = mesh_edges(mesh.faces, 0)
    divided = split_edges(mesh, edges, np.zeros(0, np.int64), np.zeros((0, 3), np.uint8))
    assert len(edges.ends) == 0 and len(divided.vertices) == 0 and divided.faces.shape == (0, 3)
