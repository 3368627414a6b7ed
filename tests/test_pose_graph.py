"""Pose graphs: the solution against a dense one, drift that a loop removes, and edges that are wrong."""

import numpy as np
import pytest

from spslam.geometry import compose, inverse, pose_from, rotation_angle
from spslam.pose_graph import PoseEdges, optimize_pose_graph, rotation_matrices, rotation_vectors

DEVIATION = 0.002  # m and rad, of a measurement


def circle(count, radius=1.5):
    """Poses on a circle, looking along it."""
    angles = 2 * np.pi * np.arange(count) / count
    rotations = rotation_matrices(np.stack([0 * angles, angles, 0 * angles], 1))
    return pose_from(rotations, radius * np.stack([np.cos(angles), 0 * angles, -np.sin(angles)], 1))


def measured(poses, pairs, seed=0, deviation=DEVIATION):
    """T_target_source of pairs (source, target), with noise."""
    noise = np.random.default_rng(seed).normal(0, deviation, (len(pairs), 6))
    result = np.array([inverse(poses[target]) @ poses[source] for source, target in pairs])
    result[:, :3, 3] += noise[:, :3]
    result[:, :3, :3] = rotation_matrices(noise[:, 3:]) @ result[:, :3, :3]
    return result


def edges_of(pairs, matrices, may_be_wrong=None):
    sources, targets = np.array(pairs).T
    information = np.tile(np.eye(6) / DEVIATION**2, (len(pairs), 1, 1))
    wrong = np.zeros(len(pairs), bool) if may_be_wrong is None else np.array(may_be_wrong)
    return PoseEdges(sources, targets, matrices, information, wrong)


def chained(matrices):
    poses = [np.eye(4)]
    for matrix in matrices:
        poses.append(poses[-1] @ matrix)
    return np.array(poses)


def first_fixed(count):
    return np.arange(count) == 0


def largest_error(poses, truth):
    relative = compose(inverse(truth[0]), truth)
    return np.linalg.norm(poses[:, :3, 3] - relative[:, :3, 3], axis=1).max()


def test_rotation_vectors_and_matrices_are_inverse():
    vectors = np.random.default_rng(0).normal(size=(50, 3))
    vectors[0], vectors[1] = 0, (1e-10, 0, 0)
    np.testing.assert_allclose(rotation_vectors(rotation_matrices(vectors)), vectors, atol=1e-9)


@pytest.mark.parametrize("length", [0.0, 1e-10, 1e-5, 0.3, 3.1])
def test_one_vector_and_matrix_are_those_of_a_batch(length):
    vectors = np.random.default_rng(1).normal(size=(20, 3))
    vectors *= length / np.linalg.norm(vectors, axis=1, keepdims=True)
    matrices = rotation_matrices(vectors)
    np.testing.assert_allclose(np.stack([rotation_matrices(each) for each in vectors]), matrices, rtol=0, atol=1e-14)
    alone = np.stack([rotation_vectors(each) for each in matrices])
    np.testing.assert_allclose(alone, rotation_vectors(matrices), rtol=0, atol=1e-14)


def test_chain_alone_is_kept():
    truth = circle(20)
    pairs = [(i, i - 1) for i in range(1, 20)]
    steps = measured(truth, pairs)
    solved = optimize_pose_graph(np.tile(np.eye(4), (20, 1, 1)), edges_of(pairs, steps), first_fixed(20))
    np.testing.assert_allclose(solved.poses, chained(steps), atol=1e-5)
    assert solved.errors.max() < 1e-3


def test_loop_removes_drift():
    truth, count = circle(60), 60
    pairs = [(i, i - 1) for i in range(1, count)]
    steps = measured(truth, pairs, deviation=0.01)
    start = chained(steps)
    loop = [(count - 1, 0), (count - 2, 1)]
    edges = edges_of([*pairs, *loop], np.concatenate([steps, measured(truth, loop)]))
    solved = optimize_pose_graph(start, edges, first_fixed(count))
    assert largest_error(solved.poses, truth) < 0.6 * largest_error(start, truth)
    end = compose(inverse(truth[0]), truth[-1])
    before, after = (np.linalg.norm(poses[-1, :3, 3] - end[:3, 3]) for poses in (start, solved.poses))
    assert after < 0.02 < 0.1 < before


def test_wrong_edge_does_no_harm():
    truth, count = circle(40), 40
    pairs = [(i, i - gap) for gap in (1, 2, 3) for i in range(gap, count)]
    edges = edges_of(pairs, measured(truth, pairs))
    start = chained(edges.measured[: count - 1])
    without = optimize_pose_graph(start, edges, first_fixed(count))
    wrong = pose_from(np.eye(3), np.array([0.5, 0.0, 0.0]))
    more = edges_of([*pairs, (30, 5)], np.concatenate([edges.measured, wrong[None]]), [False] * len(pairs) + [True])
    solved = optimize_pose_graph(start, more, first_fixed(count))
    assert solved.weights[-1] < 1e-4
    np.testing.assert_allclose(solved.poses, without.poses, atol=1e-3)


def test_it_is_the_least_squares_solution():
    """Against steps of a dense solver on numeric derivatives."""
    truth, pairs = circle(6), [(1, 0), (2, 1), (3, 2), (4, 3), (5, 4), (5, 0), (3, 0)]
    edges = edges_of(pairs, measured(truth, pairs, deviation=0.02))
    start = compose(inverse(truth[0]), truth)
    solved = optimize_pose_graph(start, edges, first_fixed(6))

    def cost(step):
        poses = solved.poses.copy()
        poses[1:, :3, 3] += step[:, :3]
        poses[1:, :3, :3] = rotation_matrices(step[:, 3:]) @ poses[1:, :3, :3]
        relative = compose(inverse(poses[edges.targets]), poses[edges.sources])
        turned = relative[:, :3, :3] @ np.swapaxes(edges.measured[:, :3, :3], 1, 2)
        errors = np.concatenate([relative[:, :3, 3] - edges.measured[:, :3, 3], rotation_vectors(turned)], 1)
        return np.einsum("ei,eij,ej->", errors, edges.information, errors)

    least = cost(np.zeros((5, 6)))
    assert least == pytest.approx(solved.errors.sum())
    for seed in range(20):
        assert cost(np.random.default_rng(seed).normal(0, 2e-3, (5, 6))) > least


def test_what_nothing_joins_stays():
    truth = circle(5)
    start = compose(inverse(truth[0]), truth)
    pairs = [(1, 0), (2, 1)]
    solved = optimize_pose_graph(start, edges_of(pairs, measured(truth, pairs)), first_fixed(5))
    np.testing.assert_allclose(solved.poses[3:], start[3:], atol=1e-9)
    assert not np.allclose(solved.poses[2], start[2])


@pytest.mark.parametrize("fixed", [np.ones(3, bool), first_fixed(3)])
def test_without_edges_or_freedom_nothing_moves(fixed):
    start = circle(3)
    pairs = [] if fixed.sum() == 1 else [(1, 0)]
    edges = edges_of(pairs or [(1, 0)], measured(start, pairs or [(1, 0)]))
    if not pairs:
        edges = PoseEdges(*(getattr(edges, name)[:0] for name in vars(edges)))
    np.testing.assert_array_equal(optimize_pose_graph(start, edges, fixed).poses, start)


def test_the_same_bytes_every_time():
    truth, pairs = circle(30), [(i, i - 1) for i in range(1, 30)] + [(29, 0)]
    edges = edges_of(pairs, measured(truth, pairs))
    runs = [optimize_pose_graph(chained(edges.measured[:29]), edges, first_fixed(30)).poses for _ in range(2)]
    assert runs[0].tobytes() == runs[1].tobytes()
    assert rotation_angle(runs[0][:, :3, :3]).max() > 1


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"measured": np.zeros((1, 3, 3))}, "edges.measured must have shape"),
        ({"information": np.zeros((2, 6, 6))}, "edges.information must have shape"),
        ({"targets": np.array([7])}, "edges must join rows below 3, got 1 to 7"),
    ],
)
def test_wrong_arrays_are_refused(change, message):
    edges = edges_of([(1, 0)], measured(circle(3), [(1, 0)]))
    with pytest.raises(ValueError, match=message):
        optimize_pose_graph(circle(3), PoseEdges(**{**vars(edges), **change}), first_fixed(3))
