"""Each solid's ray intersection, distance, normals, samples and mesh against each other and against sphere tracing."""

import numpy as np
import pytest

from spslam.datasets.primitives import Box, Cylinder, Sphere

# Single-precision rays over a few meters.
RAY_TOLERANCE_M = 5e-6

SOLIDS = [
    Box((0.3, -0.2, 0.5), 0.0, (0.8, 0.5, 1.1)),
    Box((0.3, -0.2, 0.5), 0.7, (0.8, 0.5, 1.1)),
    Sphere((0.1, 0.2, 0.3), 0.0, 0.6),
    Cylinder((-0.2, 0.1, 0.4), 0.0, 0.5, 0.9),
]
solids = pytest.mark.parametrize("solid", SOLIDS, ids=lambda solid: f"{type(solid).__name__}-{solid.yaw}")


def trace(solid, origin, direction, far=10.0):
    """Sphere tracing in double precision: the independent way to meet a surface."""
    t = 0.0
    for _ in range(2000):
        distance = solid.signed_distance((origin + t * direction)[None])[0]
        if distance < 1e-9:
            return t
        t += distance / np.linalg.norm(direction)
        if t > far:
            break
    return np.inf


@solids
def test_intersect_agrees_with_sphere_tracing(solid):
    generator = np.random.default_rng(0)
    origin = np.array([2.0, 1.5, 1.0])
    targets = generator.normal(scale=0.6, size=(200, 3)) + solid.center
    directions = (targets - origin) / np.linalg.norm(targets - origin, axis=1, keepdims=True)
    hits = solid.intersect(origin, directions.T.astype(np.float32))
    expected = np.array([trace(solid, origin, direction) for direction in directions])
    assert 30 < np.isfinite(expected).sum() < 200
    agreeing = np.isfinite(hits) == np.isfinite(expected)
    assert agreeing.sum() >= 199  # a ray that grazes within single precision may fall on either side
    both = np.isfinite(hits) & np.isfinite(expected)
    np.testing.assert_allclose(hits[both], expected[both], atol=1e-4)
    on_surface = origin + hits[both, None].astype(np.float64) * directions[both].astype(np.float32)
    assert np.abs(solid.signed_distance(on_surface)).max() < RAY_TOLERANCE_M


@solids
def test_rays_that_lead_away_miss(solid):
    assert np.isinf(solid.intersect(np.array([3.0, 0, 0]), np.array([[1.0], [0.1], [0.1]], np.float32))).all()


@solids
def test_signed_distance_is_euclidean(solid):
    generator = np.random.default_rng(1)
    surface = solid.sample(generator, 40000)
    assert np.abs(solid.signed_distance(surface)).max() < 1e-12
    points = generator.uniform(-1.5, 1.5, (50, 3)) + solid.center
    nearest = np.linalg.norm(points[:, None] - surface[None], axis=2).min(axis=1)
    # The samples lie about 1 cm apart, so the nearest is at most that much too far.
    np.testing.assert_allclose(np.abs(solid.signed_distance(points)), nearest, atol=0.02)
    assert (solid.signed_distance(np.asarray(solid.center)[None]) < 0).all()


@solids
def test_normals_are_the_distance_s_gradient(solid):
    points = solid.sample(np.random.default_rng(2), 500)
    normals = solid.normals(points)
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1, atol=1e-9)
    outside, inside = solid.signed_distance(points + 1e-4 * normals), solid.signed_distance(points - 1e-4 * normals)
    np.testing.assert_allclose(outside, 1e-4, atol=1e-7)
    assert (inside < 0).all()


@solids
def test_samples_are_even(solid):
    points = solid.sample(np.random.default_rng(3), 60000)
    upper = points[:, 2] > solid.center[2]
    assert upper.mean() == pytest.approx(0.5, abs=0.01)
    mesh = solid.local_mesh()
    triangle = int(np.argmax(mesh.area_faces))
    if isinstance(solid, Box):
        a, b, c = solid.to_world(mesh.vertices[mesh.faces[triangle]])
        normal = np.cross(b - a, c - a)
        on_face = np.abs((points - a) @ normal / np.linalg.norm(normal)) < 1e-9
        assert on_face.mean() == pytest.approx(2 * mesh.area_faces[triangle] / mesh.area, abs=0.01)


@solids
def test_mesh_lies_on_the_surface(solid):
    mesh = solid.local_mesh()
    assert np.abs(solid.signed_distance(solid.to_world(mesh.vertices))).max() < 1e-9
    assert mesh.area == pytest.approx(solid.area, rel=2e-3)
    assert mesh.volume > 0  # faces point outward


@solids
def test_corners_enclose_the_solid(solid):
    low, high = solid.corners().min(axis=0), solid.corners().max(axis=0)
    points = solid.sample(np.random.default_rng(4), 1000)
    assert (points >= low - 1e-9).all()
    assert (points <= high + 1e-9).all()
