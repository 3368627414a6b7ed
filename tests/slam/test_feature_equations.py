"""What image features want of a pose, against differences of their errors; what rays without depth can tell; and the
pose that they hold, against plain NumPy."""

import math

import numpy as np
import pytest

from spslam.geometry import matrix_to_pose7, pose_from, rotation_angle
from spslam.pose_graph import rotation_matrices
from spslam.slam.color_motion import ColorMotion
from spslam.slam.recovery.feature_equations import (
    SeenPoints,
    SeenRays,
    agreeing_points,
    held_pose,
    point_equations,
    ray_equations,
)
from tests.reference import feature_pose as reference

CAMERA = np.array([300.0, 290, 160, 120])
MATRIX = np.array([[300.0, 0, 160], [0, 290, 120], [0, 0, 1]])
# As in csrc/kernels/feature_pose.h.
DEPTH_DEVIATIONS, INVERSE_DEPTH_DEVIATION, INDEPENDENT_FEATURES = 3.0, 4.0, 50
COUNT = 30
WIDE_PX = 1e5  # errors are so small beside it that no weight falls
POSE = pose_from(rotation_matrices(np.array([0.2, -0.3, 0.1])), np.array([0.3, -0.2, 0.5]))


@pytest.fixture
def random():
    return np.random.default_rng(4)


def to_world(local):
    return local @ POSE[:3, :3].T + POSE[:3, 3]


def seen(pose, points):
    """Where a pose's image shows points, px."""
    x, y, z = MATRIX @ (pose[:3, :3].T @ (points - pose[:3, 3]).T)
    return np.stack([x / z, y / z], 1)


def exact(points, positions):
    """Points whose depth has no noise."""
    return SeenPoints(points, positions, np.zeros_like(points))


def rays_of(origin, directions, positions, beyond_m):
    return SeenRays(origin, directions, positions, np.full(len(positions), beyond_m))


def test_few_rays_weigh_no_more_than_as_many_points(random):
    directions = to_world(random.uniform([-0.5, -0.4, 1], [0.5, 0.4, 1], (COUNT, 3))) - POSE[:3, 3]
    rays = rays_of(POSE[:3, 3], directions, seen(POSE, directions + POSE[:3, 3]), 4.0)
    _, alone, _ = ray_equations(CAMERA, rays, POSE, 3.0)
    _, beside, _ = ray_equations(CAMERA, rays, POSE, 3.0, least=10 * INDEPENDENT_FEATURES)
    np.testing.assert_allclose(beside, alone / 10, rtol=1e-9)


def stepped(pose, step):
    return pose_from(rotation_matrices(step[3:]) @ pose[:3, :3], pose[:3, 3] + step[:3])


def check_equations(found, errors):
    """Matrix and gradient by differences of half the squared errors, of which all count alike."""
    small = 1e-6 * np.eye(6)
    jacobian = np.stack([(errors(one) - errors(-one)) / 2e-6 for one in small], 1)
    agreeing, matrix, gradient = found
    assert agreeing == COUNT
    np.testing.assert_allclose(matrix, jacobian.T @ jacobian, rtol=0, atol=1e-4 * np.abs(matrix).max())
    np.testing.assert_allclose(gradient, jacobian.T @ errors(np.zeros(6)), rtol=0, atol=1e-4 * np.abs(gradient).max())


def test_equations_of_points_are_those_of_their_errors(random):
    points = to_world(random.uniform([-1, -1, 1.5], [1, 1, 3], (COUNT, 3)))
    positions = random.uniform([0, 0], [320, 240], (COUNT, 2))
    share = math.sqrt(min(1.0, INDEPENDENT_FEATURES / COUNT)) / WIDE_PX
    check_equations(
        point_equations(CAMERA, exact(points, positions), POSE, WIDE_PX),
        lambda step: (seen(stepped(POSE, step), points) - positions).ravel() * share,
    )


def check_along_epipolar_lines(found, positions_at, deviation, positions, error_px):
    """Equations of errors that may be off by `deviation` of the parameter of `positions_at(pose, parameter)` too."""
    along = (positions_at(POSE, 1e-5) - positions_at(POSE, -1e-5)) / 2e-5
    assert np.linalg.norm(deviation * along, axis=1).min() > 0.5 * error_px  # it matters
    variance = error_px**2 * np.eye(2) + deviation**2 * along[:, :, None] * along[:, None]
    roots = np.linalg.cholesky(np.linalg.inv(variance))  # of the information, lower
    share = math.sqrt(min(1.0, INDEPENDENT_FEATURES / COUNT))

    def errors(step):
        off = positions_at(stepped(POSE, step), 0.0) - positions
        return share * np.einsum("nji,nj->ni", roots, off).ravel()

    check_equations(found, errors)


def test_equations_of_noisy_points_are_those_of_errors_across_their_epipolar_lines(random):
    """As if the depth of each were solved for too."""
    origin = POSE[:3, 3] + np.array([0.3, -0.2, 0.1])
    points = to_world(random.uniform([-0.5, -0.4, 1], [0.5, 0.4, 2], (COUNT, 3)))
    sight = (points - origin) / np.linalg.norm(points - origin, axis=1)[:, None]
    positions = seen(POSE, points) + random.normal(0, 1e-3, (COUNT, 2))
    check_along_epipolar_lines(
        point_equations(CAMERA, SeenPoints(points, positions, 0.02 * sight), POSE, 3.0),
        lambda pose, at: seen(pose, points + at * sight),
        0.02 * DEPTH_DEVIATIONS,
        positions,
        3.0,
    )


@pytest.mark.parametrize("deviation", [0.0, 0.02])
def test_points_that_agree_are_those_that_the_equations_count(random, deviation):
    points = to_world(random.uniform([-0.5, -0.4, 1], [0.5, 0.4, 2], (COUNT, 3)))
    deviations = deviation * (points - POSE[:3, 3] - np.array([0.3, -0.2, 0.1]))
    shown = SeenPoints(points, seen(POSE, points) + random.normal(0, 3.0, (COUNT, 2)), deviations)
    agreeing = np.count_nonzero(agreeing_points(CAMERA, shown, POSE, 3.0))
    assert 0 < agreeing < COUNT
    assert agreeing == point_equations(CAMERA, shown, POSE, 3.0)[0]


def test_points_behind_the_camera_tell_nothing(random):
    points = to_world(np.array([[0.1, 0.2, -1.0], [0.0, 0.0, 0.0]]))
    agreeing, matrix, gradient = point_equations(CAMERA, exact(points, np.zeros((2, 2))), POSE, 3.0)
    assert agreeing == 0 and not matrix.any() and not gradient.any()


def test_equations_of_rays_are_those_of_errors_across_their_epipolar_lines(random):
    """As if the inverse depth of each were solved for too, from what it is expected to be and as firmly."""
    beyond_m, inverse_depth = 4.0, 0.125
    origin = POSE[:3, 3] + np.array([0.1, 0.05, -0.2])
    directions = to_world(random.uniform([-0.5, -0.4, 1], [0.5, 0.4, 1], (COUNT, 3))) - POSE[:3, 3]

    def positions_at(pose, more):
        x, y, z = MATRIX @ (pose[:3, :3].T @ (directions + (inverse_depth + more) * (origin - pose[:3, 3])).T)
        return np.stack([x / z, y / z], 1)

    positions = positions_at(POSE, 0.0) + random.normal(0, 1e-3, (COUNT, 2))
    found = ray_equations(CAMERA, rays_of(origin, directions, positions, beyond_m), POSE, 3.0)
    check_along_epipolar_lines(found, positions_at, INVERSE_DEPTH_DEVIATION * inverse_depth, positions, 3.0)


@pytest.mark.parametrize("depth_m", [2.0, 5.0, 1e4])
def test_rays_tell_how_the_camera_has_turned(random, depth_m):
    """Points on a small patch leave a turn about it nearly free; what lies beyond 2 m holds it, however far it is."""
    near = to_world(np.array([0.0, 0.3, 1.5]) + random.uniform(-0.1, 0.1, (40, 3)) * [1, 1, 0])
    far = to_world(depth_m * random.uniform([-0.5, -0.4, 1], [0.5, 0.4, 1], (200, 3)))
    true = stepped(POSE, np.array([0.03, 0.01, -0.02, 0.01, -0.02, 0.015]))
    shown_near = seen(true, near) + random.normal(0, 0.5, (40, 2))
    shown_far = seen(true, far) + random.normal(0, 0.5, (200, 2))
    rays = rays_of(POSE[:3, 3], (far - POSE[:3, 3]) / depth_m, shown_far, 2.0)

    def off(with_rays):
        at = POSE
        for _ in range(10):
            _, matrix, gradient = point_equations(CAMERA, exact(near, shown_near), at, 3.0)
            if with_rays:
                _, more, toward = ray_equations(CAMERA, rays, at, 3.0)
                matrix, gradient = matrix + more, gradient + toward
            at = stepped(at, -np.linalg.solve(matrix + 1e-9 * np.eye(6), gradient))
        turn = np.degrees(rotation_angle(at[:3, :3].T @ true[:3, :3]))
        return 100 * float(np.linalg.norm(at[:3, 3] - true[:3, 3])), float(turn)

    cm, deg = off(with_rays=True)
    assert cm < 5 and deg < 0.7
    cm_without, deg_without = off(with_rays=False)
    assert cm_without > 3 * cm and deg_without > 10 * deg


def test_rays_of_a_camera_that_has_only_turned_count_along_all_directions(random):
    directions = to_world(random.uniform([-0.5, -0.4, 1], [0.5, 0.4, 1], (COUNT, 3))) - POSE[:3, 3]
    turned = stepped(POSE, np.array([0, 0, 0, 0.002, -0.003, 0.001]))
    positions = seen(turned, directions + POSE[:3, 3])
    agreeing, matrix, gradient = ray_equations(CAMERA, rays_of(POSE[:3, 3], directions, positions, 4.0), POSE, 3.0)
    assert agreeing == COUNT
    assert np.linalg.eigvalsh(matrix[3:, 3:]).min() > 1e3
    step = -np.linalg.solve(matrix[3:, 3:], gradient[3:])
    np.testing.assert_allclose(step, [0.002, -0.003, 0.001], atol=2e-5)


def shaken(pose, random, size=0.01):
    return stepped(pose, random.normal(0, size, 6))


def held_case(random, motion=None):
    """Points and rays of two earlier frames as a moved camera's color image sees them, and where surface has put it."""
    points = to_world(random.uniform([-0.8, -0.6, 1], [0.8, 0.6, 3], (200, 3)))
    far = to_world(random.uniform([-3, -2, 8], [3, 2, 12], (2, 60, 3)))
    moved = stepped(POSE, np.array([0.02, -0.01, 0.03, 0.01, 0.02, -0.01]))
    true = moved if motion is None else motion.color_pose(moved)
    sight = points - POSE[:3, 3]
    shown = SeenPoints(points, seen(true, points) + random.normal(0, 0.4, (200, 2)), 0.005 * sight)
    rays = [
        rays_of(origin, (each - origin) / (POSE[:3, :3].T @ (each - origin).T)[2:].T, seen(true, each), 4.0)
        for origin, each in zip((POSE[:3, 3], true[:3, 3]), far, strict=True)
    ]
    root = random.normal(0, 1, (6, 6))
    return shown, rays, matrix_to_pose7(shaken(moved, random)), 1e3 * root @ root.T


@pytest.mark.parametrize("share", [None, 0.3, -0.5, 20.0], ids=["one moment", "late", "early", "jumped"])
@pytest.mark.parametrize("with_rays", [False, True])
def test_pose_is_held_as_by_plain_numpy(random, share, with_rays):
    motion = None if share is None else ColorMotion(shaken(POSE, random, 0.02), share)
    points, rays, pose, information = held_case(random, motion)
    arguments = CAMERA, points, rays if with_rays else [], motion, pose, information, 3.0, 20
    wanted, found = reference.held_pose(*arguments), held_pose(*arguments)
    assert np.abs(wanted - pose).max() > 1e-3  # it has moved
    np.testing.assert_allclose(found, wanted, atol=1e-9)


def test_pose_is_not_held_by_too_few_points(random):
    points, rays, pose, information = held_case(random)
    assert held_pose(CAMERA, points, rays, None, pose, information, 3.0, 1000) is None
    few = SeenPoints(*(each[:0] for each in points.arrays))
    assert held_pose(CAMERA, few, rays, None, pose, information, 3.0, 1) is None


def test_arrays_in_any_layout_are_taken(random):
    points, rays, pose, information = held_case(random)
    wanted = held_pose(CAMERA, points, rays, None, pose, information, 3.0, 20)
    strided = SeenPoints(*(np.asfortranarray(each) for each in points.arrays))
    single = SeenRays(*(each.astype(np.float32) for each in rays[0].arrays))
    found = held_pose(CAMERA, strided, [single, rays[1]], None, pose, np.asfortranarray(information), 3.0, 20)
    np.testing.assert_allclose(found, wanted, atol=1e-6)
    np.testing.assert_array_equal(
        agreeing_points(CAMERA, strided, POSE, 3.0), agreeing_points(CAMERA, points, POSE, 3.0)
    )
