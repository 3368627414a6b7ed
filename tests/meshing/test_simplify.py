"""Simplification by vertex clustering."""

import numpy as np
import pytest
import trimesh

from spslam.meshing.load import Mesh
from spslam.meshing.simplify import cluster_vertices, simplify_mesh


def plane(count: int = 60) -> Mesh:
    """A flat square of 1 m with a color ramp."""
    rows, columns = np.mgrid[:count, :count] / (count - 1)
    vertices = np.stack([columns, rows, np.zeros_like(rows)], axis=-1).reshape(-1, 3)
    corner = (count * np.arange(count - 1)[:, None] + np.arange(count - 1)).reshape(-1, 1)
    faces = np.concatenate([corner + (0, 1, count), corner + (1, count + 1, count)])
    colors = np.rint(255 * vertices).astype(np.uint8)
    return Mesh(vertices, faces, colors)


def area(mesh: Mesh) -> float:
    a, b, c = (mesh.vertices[mesh.faces[:, i]] for i in range(3))
    return float(0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1).sum())


@pytest.mark.parametrize("max_faces", [1, 50, 1000, 3000])
def test_result_has_few_enough_faces_and_looks_the_same(max_faces):
    mesh = plane()
    simple = simplify_mesh(mesh, max_faces)
    assert 0 < len(simple.faces) <= max_faces
    if max_faces >= 1000:
        assert len(simple.faces) > 0.4 * max_faces
        assert area(simple) == pytest.approx(area(mesh), rel=0.1)
        # The color of a vertex still is that of its place.
        assert np.abs(simple.colors[:, :2] - 255 * simple.vertices[:, :2]).max() <= 1


def test_faces_keep_their_orientation():
    sphere = trimesh.creation.icosphere(5)
    mesh = Mesh(np.array(sphere.vertices), np.array(sphere.faces), np.zeros((len(sphere.vertices), 3), np.uint8))
    simple = simplify_mesh(mesh, 2000)
    a, b, c = (simple.vertices[simple.faces[:, i]] for i in range(3))
    outward = np.einsum("ij,ij->i", np.cross(b - a, c - a), a)
    assert (outward > 0).mean() > 0.98  # a few slivers fold over


def test_every_vertex_is_used_and_no_face_degenerate_or_twice():
    simple = cluster_vertices(plane(), 0.11)
    assert np.array_equal(np.unique(simple.faces), np.arange(len(simple.vertices)))
    assert all(len(set(face)) == 3 for face in simple.faces.tolist())
    assert len({tuple(face) for face in simple.faces.tolist()}) == len(simple.faces)


def test_a_small_mesh_is_returned_as_it_is():
    mesh = plane(4)
    assert simplify_mesh(mesh, 18) is mesh


def test_parts_far_apart_leave_something():
    generator = np.random.default_rng(0)
    centers = generator.uniform(-1e6, 1e6, (500, 1, 3))
    vertices = (centers + generator.uniform(-1e-3, 1e-3, (500, 3, 3))).reshape(-1, 3)
    mesh = Mesh(vertices, np.arange(1500).reshape(-1, 3), np.zeros((1500, 3), np.uint8))
    assert len(simplify_mesh(mesh, 100).faces) <= 100


def test_no_faces_at_all_are_refused():
    with pytest.raises(ValueError, match="simplify_mesh: max_faces must be at least 1, got 0"):
        simplify_mesh(plane(4), 0)
