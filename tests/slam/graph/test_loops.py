"""Loops: found where a place is seen again, refused where only something alike is."""

import numpy as np
import pytest

from spslam.geometry import compose, pose_from
from spslam.pose_graph import rotation_matrices
from spslam.slam.graph.edges import Link
from spslam.slam.graph.keyframe_graph import GraphContent, KeyframeGraph
from spslam.slam.graph.loops import MIN_AGE, LoopFinder
from spslam.slam.graph.overlap import Surfaces
from spslam.slam.graph.registration import Registrar
from tests.slam.graph.worlds import NOISE, keyframes, registrar, relative

PLACE, FRAMES = "room", 300
NUMBERS = tuple(range(0, 48, 4))
SPACING = 0.2, 0.2  # m and rad between keyframes


@pytest.fixture(scope="module")
def there_and_back():
    """Keyframes along a path, and the same way back, seen again."""
    frames, poses = keyframes(PLACE, FRAMES, NUMBERS)
    order = [*range(len(frames)), *reversed(range(len(frames) - 1))]
    return [frames[i] for i in order], poses[order]


def drifted(poses, per_keyframe_m, per_keyframe_rad=0.001):
    """Poses as they would be tracked with a drift that grows from keyframe to keyframe."""
    result = [poses[0]]
    for one in range(1, len(poses)):
        turn = rotation_matrices(np.array([0.0, per_keyframe_rad, 0.0]))
        step = compose(relative(poses, one, one - 1), pose_from(turn, np.array([0.0, 0.0, per_keyframe_m])))
        result.append(compose(result[-1], step))
    return np.array(result)


def graph_of(frames):
    surfaces = Surfaces()
    for frame in frames:
        surfaces.add(frame)
    return KeyframeGraph(registrar(frames[0]), surfaces, GraphContent())


def links(poses):
    return [Link(relative(poses, one, max(one - 1, 0)), False) for one in range(len(poses))]


def distances(poses, truth):
    return np.linalg.norm(poses[:, :3, 3] - truth[:, :3, 3], axis=1)


@pytest.mark.parametrize("drift", [0.001, 0.015])
def test_what_is_seen_again_removes_drift(there_and_back, drift):
    frames, truth = there_and_back
    start = drifted(truth, drift)
    update = graph_of(frames).update(frames, links(start), start, SPACING)
    assert distances(update.poses, truth)[-1] < 0.25 * distances(start, truth)[-1]
    assert drift < 0.01 or any(decision.accepted for decision in update.decisions)


def test_loops_are_left_out_where_they_are_not_wanted(there_and_back):
    frames, truth = there_and_back
    graph, start = graph_of(frames), drifted(truth, 0.015)
    update = graph.update(frames, links(start), start, SPACING, with_loops=False)
    assert update.decisions == ()
    kinds = {edge.kind for edge in graph.content.edges}
    assert "covisible" in kinds and "loop" not in kinds


def test_loops_are_decided_on_with_reasons(there_and_back):
    frames, truth = there_and_back
    graph = graph_of(frames)
    update = graph.update(frames, links(drifted(truth, 0.015)), drifted(truth, 0.015), SPACING)
    for decision in update.decisions:
        assert decision.reason and decision.correction_m >= 0
    accepted = {(decision.source, decision.target) for decision in update.decisions if decision.accepted}
    edges = {(frames[e.source].frame, frames[e.target].frame) for e in graph.content.edges if e.kind == "loop"}
    assert accepted == edges and accepted


def test_a_loop_alone_waits(there_and_back):
    frames, truth = there_and_back
    finder, waiting, lengths = LoopFinder(registrar(frames[0])), [], np.arange(len(frames)) * 0.3
    start = drifted(truth, 0.015)
    last = len(frames) - 1
    edges, decisions = finder.find(frames, {last: set()}, start, lengths, waiting)
    assert edges == [] and waiting
    assert {decision.reason for decision in decisions if not decision.accepted} >= {"waits for a second one"}


def test_more_than_drift_is_another_place(there_and_back):
    """A loop over a short path that moves the camera by a meter."""
    frames, truth = there_and_back
    far = truth.copy()
    far[len(frames) // 2 :, 2, 3] += 1.0
    finder, waiting = LoopFinder(registrar(frames[0])), []
    edges, decisions = finder.find(frames, {len(frames) - 1: set()}, far, np.arange(len(frames)) * 0.01, waiting)
    assert edges == [] and waiting == []
    assert any("no drift" in decision.reason for decision in decisions)


def test_places_that_only_look_alike_are_no_loop():
    """Columns of an arcade: what lies between two of them is another place."""
    frames, poses = keyframes("arcade", 400, tuple(range(0, 400, 40)))
    update = graph_of(frames).update(frames, links(poses), poses, SPACING)
    assert distances(update.poses, poses).max() < 0.05
    for decision in update.decisions:
        assert not decision.accepted or decision.correction_m < 0.1


def test_neighbors_in_time_are_no_loops(there_and_back):
    frames, truth = there_and_back
    finder = LoopFinder(registrar(frames[0]))
    lengths = np.arange(len(frames)) * 0.3
    assert finder.find(frames, {MIN_AGE - 1: set()}, truth, lengths, []) == ([], [])


def test_without_image_features_there_are_no_loops(there_and_back):
    frames, truth = there_and_back
    finder, waiting = LoopFinder(Registrar({frames[0].camera: NOISE}, 0, features=False)), []
    lengths = np.arange(len(frames)) * 0.3
    assert finder.find(frames, {len(frames) - 1: set()}, truth, lengths, waiting) == ([], [])
