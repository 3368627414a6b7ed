"""Generated places: exact depth, closed surfaces, and ways without collision."""

import numpy as np
import pytest

from spslam.camera import Camera
from spslam.datasets.places import MOTIONS, PLACES, Motion, make_place
from spslam.datasets.places.caster import Caster, Rays
from spslam.geometry import inverse, transform_points

CAMERA = Camera(64, 48, 55.0, 55.0, 31.5, 23.5)
# Single-precision rays over at most 30 m.
DEPTH_TOLERANCE_M = 2e-5
# A mesh of 96 chords stands back from a round surface by under 0.5 mm, seen at an angle by a few times that.
CHORD_TOLERANCE_M = 2e-3
LEAST_CLEARANCE_M = 0.25


def motion_in(place, style="walking", seed=0):
    return Motion(place.route, style, seed, place.pace)


def poses_around(place, count):
    motion = motion_in(place)
    return motion.poses(np.linspace(0, motion.round_s, count, endpoint=False))


def world_points(camera, depth, pose):
    return transform_points(pose, camera.unproject(depth).reshape(-1, 3))


def first_hits(origin, directions, triangles):
    """Distances [N] to a mesh's nearest triangle, all against all (Moeller and Trumbore)."""
    corner, edge1, edge2 = triangles[:, 0], triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]
    offset = origin - corner
    cross = np.cross(offset, edge1)
    nearest = np.full(len(directions), np.inf)
    for number, direction in enumerate(directions):
        normal = np.cross(direction, edge2)
        with np.errstate(divide="ignore", invalid="ignore"):
            scale = 1 / np.sum(edge1 * normal, axis=1)
            u, v = np.sum(offset * normal, axis=1) * scale, cross @ direction * scale
            distance = np.sum(edge2 * cross, axis=1) * scale
            met = (u >= -1e-9) & (v >= -1e-9) & (u + v <= 1 + 1e-9) & (distance > 1e-6)
        if met.any():
            nearest[number] = distance[met].min()
    return nearest


@pytest.mark.parametrize("name", PLACES)
def test_depth_is_exact_and_nothing_lies_before_it(name):
    place = make_place(name, 1)
    for pose in poses_around(place, 4):
        depth = place.depth(CAMERA, pose)
        points = world_points(CAMERA, depth, pose)
        assert np.abs(place.signed_distance(points)).max() < DEPTH_TOLERANCE_M
        for share in (0.3, 0.9):
            between = (1 - share) * pose[:3, 3] + share * points
            assert place.signed_distance(between).min() > -DEPTH_TOLERANCE_M


@pytest.mark.parametrize("name", ["room", "stairwell", "desk"])
def test_depth_is_that_of_the_mesh(name):
    check_against_mesh(name, 0, 25)


@pytest.mark.slow
@pytest.mark.parametrize("name", PLACES)
@pytest.mark.parametrize("seed", [2])
def test_depth_is_that_of_the_mesh_everywhere(name, seed):
    check_against_mesh(name, seed, 120)


def check_against_mesh(name, seed, rays):
    place = make_place(name, seed)
    vertices, faces = place.mesh(1.0)
    generator = np.random.default_rng(seed)
    errors = []
    for pose in poses_around(place, 3):
        depth = place.depth(CAMERA, pose).reshape(-1)
        pixels = generator.choice(depth.size, rays, replace=False)
        directions = CAMERA.ray_directions().reshape(-1, 3)[pixels] @ pose[:3, :3].T
        errors.append(np.abs(first_hits(pose[:3, 3], directions, vertices[faces]) - depth[pixels]))
    errors = np.concatenate(errors)
    # A ray along the silhouette of a round surface passes its chords and hits what is behind.
    assert np.mean(errors > CHORD_TOLERANCE_M) < 0.02
    assert np.median(errors) < DEPTH_TOLERANCE_M


@pytest.mark.parametrize("name", PLACES)
def test_the_camera_keeps_its_distance_for_thousands_of_frames(name):
    check_clearance(name, 0)


@pytest.mark.slow
@pytest.mark.parametrize("name", PLACES)
@pytest.mark.parametrize("seed", range(1, 3))
def test_the_camera_keeps_its_distance_in_many_places(name, seed):
    check_clearance(name, seed)


def check_clearance(name, seed):
    place = make_place(name, seed)
    for style in MOTIONS:
        centers = motion_in(place, style, seed).poses(np.arange(2500) / 10)[:, :3, 3]
        assert place.signed_distance(centers).min() > LEAST_CLEARANCE_M, style


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_loops_are_as_long_as_promised(seed):
    assert make_place("apartment", seed).route.length_m >= 60
    assert 58 <= make_place("arcade", seed).route.length_m <= 82
    assert make_place("stairwell", seed).route.length_m >= 60


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(3, 6))
def test_loops_are_as_long_as_promised_for_many_seeds(seed):
    test_loops_are_as_long_as_promised(seed)


@pytest.mark.parametrize(("name", "low", "high"), [("arcade", 3, 8), ("desk", 0.3, 1.2), ("hall", 3, 14)])
def test_depth_is_of_the_places_kind(name, low, high):
    place = make_place(name, 0)
    depth = np.stack([place.depth(CAMERA, pose) for pose in poses_around(place, 12)])
    assert np.mean((depth > low) & (depth < high)) > 0.6


def test_colors_have_detail_and_texture_scales_it():
    pose = poses_around(make_place("arcade", 0), 5)[1]
    spread = {}
    for texture in (0.0, 0.5, 1.0):
        color, _ = make_place("arcade", 0, texture).render(CAMERA, pose)
        steps = np.abs(np.diff(color.astype(int), axis=1)).max(axis=2)
        spread[texture] = np.mean(steps > 6)
    assert spread[1.0] > 0.3
    # What is left at 0 are the edges between surfaces.
    assert spread[0.0] < 0.3 * spread[1.0]
    assert spread[0.0] < spread[0.5] < spread[1.0]


def test_the_same_point_has_the_same_color_from_elsewhere():
    camera = Camera(320, 240, 277.0, 277.0, 159.5, 119.5)
    place = make_place("room", 0)
    first, second = motion_in(place).poses(np.array([0.0, 0.2]))
    (color, depth), (other, seen_depth) = (place.render(camera, pose) for pose in (first, second))
    points = transform_points(inverse(second), world_points(camera, depth, first))
    pixels = np.round(camera.project(points))
    inside = (pixels >= 0).all(axis=1) & (pixels < (320, 240)).all(axis=1)
    columns, rows = pixels[inside].astype(int).T
    seen = np.abs(seen_depth[rows, columns] - points[inside, 2]) < 0.01
    difference = np.abs(color.reshape(-1, 3)[inside][seen].astype(int) - other[rows, columns][seen])
    assert seen.sum() > 40000
    assert np.median(difference) <= 4


def test_windows_hide_nothing():
    """A solid in its window of the image gives what it gives in the whole image."""
    place = make_place("room", 2)
    caster = Caster(place._shell, place._solids)
    for pose in poses_around(place, 3):
        rays = Rays.of(CAMERA, pose)
        depth, owner = caster.cast(CAMERA, rays)
        whole = (slice(0, CAMERA.height), slice(0, CAMERA.width))
        caster._in_view = lambda camera, poses, whole=whole: [(i, 0.0, whole) for i in range(len(place._solids))]
        expected, expected_owner = caster.cast(CAMERA, rays)
        del caster._in_view
        np.testing.assert_array_equal(depth, expected)
        assert np.mean(owner != expected_owner) < 0.01  # of two surfaces at one depth, either


def test_places_differ_by_seed_and_repeat_by_seed():
    make_place.cache_clear()
    first = make_place("room", 5)
    make_place.cache_clear()
    again, other = make_place("room", 5), make_place("room", 6)
    assert again is not first
    pose = poses_around(first, 3)[1]
    for one, two in zip(first.render(CAMERA, pose), again.render(CAMERA, pose), strict=True):
        np.testing.assert_array_equal(one, two)
    assert [tuple(solid.center) for solid in first._solids] != [tuple(solid.center) for solid in other._solids]


def test_surface_samples_and_mesh_agree():
    place = make_place("stairwell", 0)
    samples = place.sample_surface(500)
    assert np.abs(place.signed_distance(samples)).max() < 1e-9
    vertices, faces = place.triangles()
    corners = vertices[faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    assert np.linalg.norm(normals, axis=1).min() > 0
    visible = place.sample_surface(300, seed=1)
    middle = corners.mean(axis=1)
    nearest = np.array([np.linalg.norm(middle - point, axis=1).min() for point in visible])
    assert nearest.max() < 0.2


def test_errors():
    with pytest.raises(ValueError, match="make_place: name must be one of room, .*, got attic"):
        make_place("attic")
    with pytest.raises(ValueError, match="make_place: texture must be from 0 to 1, got 1.5"):
        make_place("room", texture=1.5)
