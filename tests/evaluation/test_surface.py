import numpy as np
import pytest
import trimesh

from spslam.evaluation.surface import TriangleSurface, triangle_distance

SQUARE = (np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]]), np.array([[0, 1, 2], [0, 2, 3]]))
# Double precision on coordinates of meters.
EXACT_M = 1e-9


def ellipsoid(subdivisions):
    sphere = trimesh.creation.icosphere(subdivisions=subdivisions)
    return np.asarray(sphere.vertices) * [0.2, 0.2, 0.6], np.asarray(sphere.faces)


def brute_force_distance(points, vertices, faces):
    """Distance by trimesh, over all triangles."""
    mesh = trimesh.Trimesh(vertices, faces, process=False)
    return trimesh.proximity.closest_point_naive(mesh, points)[1]


def test_triangle_distance_in_every_region():
    corners = np.array([[[0.0, 0, 0], [2, 0, 0], [0, 1, 0]]])
    for point, expected in (
        ((0.3, 0.3, 0.7), 0.7),
        ((-3, -4, 0), 5),
        ((1, -2, 0), 2),
        ((2 + 3, 0, 4), 5),
        ((0, 3, 0), 2),
        ((-1, 0.5, 0), 1),
        ((2, 1, 0), 2 / np.sqrt(5)),
    ):
        assert triangle_distance(np.array([point], float), corners)[0] == pytest.approx(expected)


@pytest.mark.parametrize("subdivisions", [0, 2, 4])
def test_distance_agrees_with_brute_force(subdivisions):
    vertices, faces = ellipsoid(subdivisions)
    generator = np.random.default_rng(0)
    near = TriangleSurface(vertices, faces).sample_surface(200) + generator.normal(scale=0.02, size=(200, 3))
    points = np.concatenate((near, generator.uniform(-1, 1, (50, 3))))
    expected = brute_force_distance(points, vertices, faces)
    found = TriangleSurface(vertices, faces).distance(points)
    near = expected < 0.1
    np.testing.assert_allclose(found[near], expected[near], atol=EXACT_M)
    excess = found[~near] - expected[~near]
    assert excess.min() > -EXACT_M
    assert excess.max() < 5e-3  # far from the surface not all faces are compared


def test_distance_to_uneven_triangles():
    generator = np.random.default_rng(1)
    vertices = generator.uniform(size=(60, 3)) * [2, 1, 0.1]
    faces = np.array([generator.choice(60, 3, replace=False) for _ in range(40)])
    points = generator.uniform(size=(150, 3)) * [2, 1, 0.1]
    expected = brute_force_distance(points, vertices, faces)
    # Forty large intersecting triangles and points within 10 cm: hard for a search by sites, yet exact.
    np.testing.assert_allclose(TriangleSurface(vertices, faces).distance(points), expected, atol=EXACT_M)


def test_distance_to_slivers():
    generator = np.random.default_rng(2)
    starts = generator.uniform(size=(200, 1, 3)) * [1, 1, 0]
    corners = starts + np.array([[0, 0, 0], [0.3, 0, 0], [0.29, 0.0005, 0]]) * generator.choice([-1, 1], (200, 1, 3))
    vertices, faces = corners.reshape(-1, 3), np.arange(600).reshape(-1, 3)
    points = generator.uniform(size=(200, 3)) * [1, 1, 0.02]
    expected = brute_force_distance(points, vertices, faces)
    np.testing.assert_allclose(TriangleSurface(vertices, faces).distance(points), expected, atol=EXACT_M)


@pytest.mark.parametrize("side_m", [5, 9, 30])
def test_distance_beside_small_faces_and_on_long_ones(side_m):
    """Points of a floor of two faces, under a ball whose many faces are all nearer than the floor's sites are."""
    ball = trimesh.creation.icosphere(subdivisions=5, radius=0.05)
    middle = np.array([side_m / 2 + 0.013, 0.463 * side_m, 0.051])
    vertices = np.concatenate((side_m * SQUARE[0], ball.vertices + middle))
    surface = TriangleSurface(vertices, np.concatenate((SQUARE[1], ball.faces + 4)))
    points = np.random.default_rng(4).uniform(-0.1, 0.1, (500, 3)) * [1, 1, 0] + middle * [1, 1, 0]
    assert surface.distance(points).max() < EXACT_M


def test_distance_to_large_faces_alone():
    vertices, faces = SQUARE[0] * 40, SQUARE[1]
    points = np.random.default_rng(5).uniform(-1, 41, (100, 3))
    expected = brute_force_distance(points, vertices, faces)
    np.testing.assert_allclose(TriangleSurface(vertices, faces).distance(points), expected, atol=EXACT_M)


def test_samples_are_uniform_on_the_faces():
    vertices, faces = ellipsoid(2)
    points = TriangleSurface(vertices, faces).sample_surface(50000)
    corners = vertices[faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    areas = np.linalg.norm(normals, axis=1)
    normals /= areas[:, None]
    # The body is convex: a point lies on the face with the largest signed plane distance.
    height = points @ normals.T - np.einsum("fi,fi->f", normals, corners[:, 0])
    assert np.abs(height.max(axis=1)).max() < 1e-12
    counted = np.bincount(height.argmax(axis=1), minlength=len(faces))
    assert np.abs(counted - 50000 * areas / areas.sum()).max() < 2.01  # stratified sampling


def test_sampling_is_deterministic():
    square = TriangleSurface(*SQUARE)
    np.testing.assert_array_equal(square.sample_surface(100, seed=3), square.sample_surface(100, seed=3))
    assert not np.array_equal(square.sample_surface(100, seed=3), square.sample_surface(100, seed=4))


def test_surfaces_without_area():
    flat = TriangleSurface(np.zeros((3, 3)), np.array([[0, 1, 2]]))
    empty = TriangleSurface(np.zeros((0, 3)), np.zeros((0, 3), int))
    for surface in (flat, empty):
        assert surface.sample_surface(10).shape == (0, 3)
        assert np.isinf(surface.distance(np.zeros((2, 3)))).all()
    assert TriangleSurface(*SQUARE).sample_surface(0).shape == (0, 3)
    assert TriangleSurface(*SQUARE).distance(np.zeros((0, 3))).shape == (0,)


def test_errors():
    with pytest.raises(ValueError, match=r"TriangleSurface: vertices and faces must have shapes \(V, 3\) and \(F, 3\)"):
        TriangleSurface(np.zeros((3, 2)), np.zeros((1, 3), int))
    with pytest.raises(ValueError, match=r"TriangleSurface: faces must index 3 vertices, got 0\.\.3"):
        TriangleSurface(np.zeros((3, 3)), np.array([[0, 1, 3]]))


@pytest.mark.parametrize("size", [0.01, 0.05, 0.5, 15])
def test_every_point_of_a_face_is_within_reach_of_a_site(size):
    generator = np.random.default_rng(3)
    for flatness in (1.0, 0.1, 0.001) if size < 10 else (0.01, 0.001):
        for corners in generator.uniform(size=(20, 3, 3)) * [size, size * flatness, 0]:
            surface = TriangleSurface(corners, np.array([[0, 1, 2]]))
            _, (sites,) = surface._sites
            assert sites.tree.query(surface.sample_surface(3000))[0].max() < sites.reach
