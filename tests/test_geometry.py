import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy.spatial.transform import Rotation

from spslam import geometry

# Double precision: a few dozen operations on numbers of size 1.
EXACT = 1e-12

unit_range = st.floats(-1, 1, allow_nan=False)


def random_poses(count: int, seed: int = 0) -> np.ndarray:
    generator = np.random.default_rng(seed)
    rotations = Rotation.random(count, random_state=seed).as_matrix()
    return geometry.pose_from(rotations, generator.normal(size=(count, 3)))


def test_quaternion_to_matrix_agrees_with_scipy():
    quaternions = np.random.default_rng(1).normal(size=(50, 4))
    expected = Rotation.from_quat(quaternions[:, [1, 2, 3, 0]]).as_matrix()
    np.testing.assert_allclose(geometry.quaternion_to_matrix(quaternions), expected, atol=EXACT)


@settings(max_examples=200, deadline=None)
@given(arrays(np.float64, 4, elements=unit_range).filter(lambda q: np.linalg.norm(q) > 1e-3))
def test_matrix_to_quaternion_inverts_quaternion_to_matrix(quaternion):
    matrix = geometry.quaternion_to_matrix(quaternion)
    back = geometry.matrix_to_quaternion(matrix)
    assert back[0] >= 0
    np.testing.assert_allclose(np.linalg.norm(back), 1, atol=EXACT)
    np.testing.assert_allclose(geometry.quaternion_to_matrix(back), matrix, atol=1e-10)


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_matrix_to_quaternion_of_180_degree_rotations(axis):
    matrix = -np.eye(3)
    matrix[axis, axis] = 1
    expected = np.zeros(4)
    expected[1 + axis] = 1
    np.testing.assert_allclose(geometry.matrix_to_quaternion(matrix), expected, atol=EXACT)


def test_batches_of_any_shape_and_empty_batches():
    poses = random_poses(6).reshape(2, 3, 4, 4)
    rows = geometry.matrix_to_pose7(poses)
    assert rows.shape == (2, 3, 7)
    np.testing.assert_allclose(geometry.pose7_to_matrix(rows), poses, atol=EXACT)
    assert geometry.matrix_to_pose7(np.zeros((0, 4, 4))).shape == (0, 7)
    assert geometry.pose7_to_matrix(np.zeros((0, 7))).shape == (0, 4, 4)


def test_one_rotation_is_that_of_a_batch():
    """One matrix is worked out in plain numbers; each of the four ways to divide comes up."""
    axes = np.concatenate([Rotation.random(40, random_state=3).as_matrix(), np.diag([1.0, -1.0, -1.0])[None]])
    alone = np.stack([geometry.matrix_to_quaternion(each) for each in axes])
    np.testing.assert_allclose(alone, geometry.matrix_to_quaternion(axes), rtol=0, atol=EXACT)


def test_orthonormalize_returns_the_nearest_rotation():
    generator = np.random.default_rng(2)
    rotations = Rotation.random(30, random_state=2).as_matrix()
    disturbed = rotations + generator.normal(scale=1e-2, size=rotations.shape)
    projected = geometry.orthonormalize(disturbed)
    identity = np.broadcast_to(np.eye(3), projected.shape)
    np.testing.assert_allclose(projected @ np.swapaxes(projected, -1, -2), identity, atol=EXACT)
    np.testing.assert_allclose(np.linalg.det(projected), 1, atol=EXACT)
    distance = np.linalg.norm(projected - disturbed, axis=(1, 2))
    turned = projected @ Rotation.random(30, random_state=3).as_matrix()
    assert np.all(distance <= np.linalg.norm(turned - disturbed, axis=(1, 2)))
    np.testing.assert_allclose(geometry.orthonormalize(rotations), rotations, atol=EXACT)


def test_orthonormalize_of_a_reflection_is_a_rotation():
    assert np.linalg.det(geometry.orthonormalize(np.diag([1.0, 1.0, -1.0]))) == pytest.approx(1)


def test_compose_and_inverse():
    a, b = random_poses(2)
    np.testing.assert_allclose(geometry.compose(a, b), a @ b, atol=EXACT)
    np.testing.assert_allclose(geometry.inverse(a), np.linalg.inv(a), atol=EXACT)
    np.testing.assert_allclose(geometry.compose(a, geometry.inverse(a)), np.eye(4), atol=EXACT)
    np.testing.assert_allclose(geometry.compose(), np.eye(4))


def test_constant_speed_repeats_the_last_motion():
    start = random_poses(1)[0]
    step = geometry.pose_from(Rotation.from_rotvec([0.01, -0.03, 0.02]).as_matrix(), [0.02, 0.0, 0.01])
    expected = start @ step @ step
    np.testing.assert_allclose(geometry.constant_speed(start, start @ step), expected, atol=EXACT)


def test_interpolate_pose_rotates_evenly_along_the_shorter_arc():
    a = geometry.pose_from(Rotation.from_rotvec([0, 0, 3.0]).as_matrix(), [0, 0, 0])
    b = geometry.pose_from(Rotation.from_rotvec([0, 0, -3.0]).as_matrix(), [1, 2, 3])
    middle = geometry.interpolate_pose(a, b, 0.5)
    half_turn = Rotation.from_rotvec([0, 0, np.pi]).as_matrix()
    np.testing.assert_allclose(middle, geometry.pose_from(half_turn, [0.5, 1, 1.5]), atol=EXACT)
    many = geometry.interpolate_pose(a, b, np.linspace(0, 1, 5))
    np.testing.assert_allclose(many[0], a, atol=EXACT)
    np.testing.assert_allclose(many[-1], b, atol=EXACT)
    steps = geometry.rotation_angle(np.swapaxes(many[:-1, :3, :3], 1, 2) @ many[1:, :3, :3])
    np.testing.assert_allclose(steps, steps[0], atol=1e-9)


def test_interpolate_pose_between_equal_poses():
    pose = random_poses(1)[0]
    np.testing.assert_allclose(geometry.interpolate_pose(pose, pose, 0.3), pose, atol=EXACT)


@pytest.mark.parametrize("angle", [0.0, 1e-9, 1e-4, 1.0, np.pi - 1e-6, np.pi])
def test_rotation_angle(angle):
    rotation = Rotation.from_rotvec(np.array([0.6, -0.8, 0]) * angle).as_matrix()
    assert geometry.rotation_angle(rotation) == pytest.approx(angle, rel=1e-6, abs=1e-15)


@pytest.mark.parametrize("scale", [1.0, 2.5])
def test_umeyama_recovers_a_similarity(scale):
    pose = random_poses(1, seed=5)[0]
    points = np.random.default_rng(5).normal(size=(40, 3))
    moved = scale * points @ pose[:3, :3].T + pose[:3, 3]
    rotation, translation, found = geometry.umeyama(points, moved, with_scale=True)
    np.testing.assert_allclose(rotation, pose[:3, :3], atol=EXACT)
    np.testing.assert_allclose(translation, pose[:3, 3], atol=1e-10)
    assert found == pytest.approx(scale)
    rotation, _, found = geometry.umeyama(points, moved)
    np.testing.assert_allclose(rotation, pose[:3, :3], atol=EXACT)
    assert found == 1


def test_umeyama_never_returns_a_reflection():
    points = np.random.default_rng(6).normal(size=(20, 3))
    rotation, _, _ = geometry.umeyama(points, points * [1, 1, -1], with_scale=True)
    assert np.linalg.det(rotation) == pytest.approx(1)


def test_umeyama_of_one_point():
    rotation, translation, scale = geometry.umeyama([[1.0, 2, 3]], [[4.0, 5, 6]], with_scale=True)
    np.testing.assert_allclose(rotation @ [1, 2, 3] * scale + translation, [4, 5, 6])
    assert np.linalg.det(rotation) == pytest.approx(1)


def test_transform_points():
    pose = random_poses(1)[0]
    points = np.random.default_rng(7).normal(size=(5, 3))
    expected = (pose @ np.c_[points, np.ones(5)].T).T[:, :3]
    np.testing.assert_allclose(geometry.transform_points(pose, points), expected, atol=EXACT)
    assert geometry.transform_points(pose, np.zeros((0, 3))).shape == (0, 3)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: geometry.quaternion_to_matrix(np.zeros(4)), "quaternion must have a length above 0, got 0"),
        (lambda: geometry.quaternion_to_matrix(np.ones(3)), r"quaternion must have shape \(..., 4\), got \(3,\)"),
        (lambda: geometry.inverse(np.eye(3)), r"inverse: pose must have shape \(..., 4, 4\), got \(3, 3\)"),
        (lambda: geometry.umeyama(np.ones((2, 3)), np.ones((3, 3))), r"shape \(N, 3\) .* got \(2, 3\) and \(3, 3\)"),
        (lambda: geometry.umeyama(np.ones((0, 3)), np.ones((0, 3))), "with N >= 1"),
    ],
)
def test_errors(call, message):
    with pytest.raises(ValueError, match=message):
        call()
