"""Normals, edges, parts and components of meshes, compiled, against plain NumPy."""

import numpy as np
import pytest

from spslam.meshing import TriangleMesh
from spslam.meshing.mesh import component_areas, face_normals, vertex_normals
from spslam.meshing.subdivision import mesh_edges, midpoints, split_edges


def random_mesh(seed, vertices=40, faces=90):
    """Faces between any vertices, some of them degenerate, and vertices of no face."""
    random = np.random.default_rng(seed)
    points = random.normal(0, 1, (vertices, 3)).astype(np.float32)
    corners = random.integers(0, vertices - 3, (faces, 3)).astype(np.int32)
    colors = random.integers(0, 256, (vertices, 3)).astype(np.uint8)
    return TriangleMesh(points, corners, colors, vertex_normals(points, corners))


@pytest.fixture(params=range(5))
def mesh(request):
    return random_mesh(request.param)


def test_normals(mesh):
    normals = face_normals(mesh.vertices.astype(float), mesh.faces)
    total = np.zeros((len(mesh.vertices), 3))
    for corner in range(3):
        np.add.at(total, mesh.faces[:, corner], normals)
    length = np.linalg.norm(total, axis=1, keepdims=True)
    wanted = np.divide(total, length, out=np.zeros_like(total), where=length > 0)
    np.testing.assert_allclose(mesh.normals, wanted, atol=1e-6)
    assert not mesh.normals[-3:].any()


def test_edges(mesh):
    pairs = np.sort(np.stack([mesh.faces, np.roll(mesh.faces, -1, axis=1)], axis=2), axis=2)
    wanted, of_faces = np.unique(pairs.reshape(-1, 2), axis=0, return_inverse=True)
    edges = mesh_edges(mesh.faces, len(mesh.vertices))
    assert np.array_equal(edges.ends, wanted)
    assert np.array_equal(edges.of_faces, of_faces.reshape(-1, 3))


def test_middles_of_edges(mesh):
    ends = mesh_edges(mesh.faces, len(mesh.vertices)).ends
    points, normals = midpoints(mesh, ends)
    np.testing.assert_array_equal(points, 0.5 * (mesh.vertices[ends[:, 0]] + mesh.vertices[ends[:, 1]]))
    sums = mesh.normals[ends].sum(1)
    length = np.linalg.norm(sums, axis=1, keepdims=True)
    np.testing.assert_allclose(normals, np.divide(sums, length, out=np.zeros_like(sums), where=length > 0), atol=1e-6)


@pytest.mark.parametrize("share", [0.0, 0.4, 1.0])
def test_parts_of_faces(mesh, share):
    """Each face's parts follow one another, have its middles as corners, its normal, and its area together."""
    edges = mesh_edges(mesh.faces, len(mesh.vertices))
    chosen = np.flatnonzero(np.random.default_rng(1).random(len(edges.ends)) < share)
    divided = split_edges(mesh, edges, chosen, np.zeros((len(chosen), 3), np.uint8))
    middle = np.full(len(edges.ends), -1)
    middle[chosen] = len(mesh.vertices) + np.arange(len(chosen))
    own = middle[edges.of_faces]
    counts = 1 + (own >= 0).sum(1)
    assert counts.sum() == len(divided.faces)
    for face, middles, parts in zip(mesh.faces, own, np.split(divided.faces, np.cumsum(counts)[:-1]), strict=True):
        assert set(parts.ravel().tolist()) == {*face.tolist(), *middles[middles >= 0].tolist()}
        normals = face_normals(divided.vertices.astype(float), parts)
        np.testing.assert_allclose(normals.sum(0), face_normals(mesh.vertices.astype(float), face[None])[0], atol=1e-5)


def test_components_have_the_area_of_their_faces(mesh):
    label = np.arange(len(mesh.vertices))
    for _ in range(len(label)):
        for face in mesh.faces:
            label[face] = label[face].min()
    area = np.linalg.norm(face_normals(mesh.vertices.astype(float), mesh.faces), axis=1) / 2
    of_faces = label[mesh.faces[:, 0]]
    wanted = [area[of_faces == each].sum() for each in of_faces]
    np.testing.assert_allclose(component_areas(mesh.vertices, mesh.faces), wanted, rtol=1e-12)


def test_two_components_are_told_apart():
    vertices = np.array([(0, 0, 0), (1, 0, 0), (0, 1, 0), (5, 0, 0), (7, 0, 0), (5, 2, 0)], np.float32)
    faces = np.array([(0, 1, 2), (3, 4, 5), (3, 5, 4)], np.int32)
    assert component_areas(vertices, faces).tolist() == [0.5, 4.0, 4.0]
    assert component_areas(vertices, faces, np.array([False, True, False])).tolist() == [0.0, 2.0, 2.0]
    with pytest.raises(ValueError, match=r"counted must have shape \(3,\), got \(2,\)"):
        component_areas(vertices, faces, np.ones(2, bool))


def test_nothing_of_no_faces():
    points, none = np.zeros((3, 3), np.float32), np.zeros((0, 3), np.int32)
    assert not vertex_normals(points, none).any() and len(component_areas(points, none)) == 0
    assert len(mesh_edges(none, 0).ends) == 0


@pytest.mark.parametrize("faces", [[(0, 1, 3)], [(-1, 1, 2)]])
def test_faces_of_other_vertices_are_refused(faces):
    points = np.zeros((3, 3), np.float32)
    for call in (vertex_normals, component_areas, lambda points, faces: mesh_edges(faces, len(points))):
        with pytest.raises(ValueError, match="faces must be indices of 3 vertices"):
            call(points, np.array(faces))


def test_ends_of_other_vertices_are_refused(mesh):
    with pytest.raises(ValueError, match="ends must be"):
        midpoints(mesh, np.array([[0, len(mesh.vertices)]]))
