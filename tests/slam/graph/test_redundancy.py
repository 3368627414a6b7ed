"""Keyframes that show nothing new are left out; what is known of them goes on with their references."""

import numpy as np
import pytest

from spslam.geometry import compose, inverse, pose_from
from spslam.pose_graph import optimize_pose_graph, rotation_matrices
from spslam.slam.graph.edges import GraphEdge, pose_edges
from spslam.slam.graph.keyframe_graph import GraphContent
from spslam.slam.graph.overlap import Surfaces
from spslam.slam.graph.redundancy import RECENT, SIMILAR, moved_anchors, moved_edges, redundant_keyframes
from tests.slam.graph.worlds import keyframes, relative

PLACE, FRAMES = "room", 300
NUMBERS = tuple(range(0, 60, 15))
SPACING = (0.2, np.radians(12))


@pytest.fixture(scope="module")
def known_place():
    """Keyframes of four places that are seen again and again, their poses, their surfaces, and edges among them."""
    frames, truth = keyframes(PLACE, FRAMES, NUMBERS)
    places = np.tile(np.arange(len(NUMBERS)), 8)
    surfaces = Surfaces()
    for at in places:
        surfaces.add(frames[at])
    poses = truth[places]
    edges = [edge("tracked", poses, one, one - 1) for one in range(1, len(places))]
    before = {at: np.flatnonzero(places == at) for at in range(len(NUMBERS))}
    for one, at in enumerate(places):
        edges += [edge("covisible", poses, one, int(other)) for other in before[at] if other < one]
    return places, poses, surfaces, edges


def edge(kind, poses, source, target):
    return GraphEdge(kind, source, target, relative(poses, source, target), 1e4 * np.eye(6))


def left_out(known_place, candidates=None):
    places, poses, surfaces, edges = known_place
    return redundant_keyframes(candidates or range(1, len(places)), poses, SPACING, edges, surfaces)


def test_a_place_keeps_so_many_keyframes_however_often_it_is_seen(known_place):
    places, out = known_place[0], left_out(known_place)
    kept = np.delete(places, list(out))
    assert np.bincount(kept).tolist() == [SIMILAR] * len(NUMBERS)
    assert all(places[one] == places[reference] and reference not in out for one, reference in out.items())


def test_what_was_not_registered_stays(known_place):
    places, poses, surfaces, edges = known_place
    tracked = [each for each in edges if each.kind == "tracked"]
    assert redundant_keyframes(range(1, len(places)), poses, SPACING, tracked, surfaces) == {}


def test_what_shows_something_else_stays(known_place):
    """The same viewpoints by what is believed, but other surface: a wall has been moved, or the poses are wrong."""
    places, poses, surfaces, edges = known_place
    wrong = poses.copy()
    turn = rotation_matrices(np.array([0.0, np.pi, 0.0]))
    wrong[-5] = compose(poses[-5], pose_from(turn, np.zeros(3)))
    assert len(places) - 5 not in redundant_keyframes(range(1, len(places)), wrong, SPACING, edges, surfaces)


def test_edges_go_on_with_the_references(known_place):
    places, poses, _, edges = known_place
    out = left_out(known_place, range(1, len(places) - RECENT))
    moved = moved_edges(edges, out, poses)
    assert not any(end in out for each in moved for end in (each.source, each.target))
    assert len(moved) < len(edges)
    for each in moved:  # they say what is so
        np.testing.assert_allclose(each.measured, relative(poses, each.source, each.target), atol=1e-9)
    joined = [edge for edge in moved if edge not in edges]
    assert joined and all(np.trace(each.information) < 6e4 for each in joined)  # and are not as sure of it as before
    content = GraphContent(list(edges), {(5, 4), (len(places) - 1, 2)}, len(places))
    content.leave_out(out, poses)
    kept = np.delete(poses, list(out), 0)
    assert content.done == len(kept)
    start = compose(kept, pose_from(rotation_matrices(np.array([0.0, 0.01, 0.0])), np.array([0.02, 0.0, 0.0])))
    start[0] = kept[0]
    solved = optimize_pose_graph(start, pose_edges(content.edges), np.arange(len(kept)) == 0).poses
    np.testing.assert_allclose(solved, kept, atol=1e-4)  # no keyframe hangs loose


def test_frames_follow_the_references():
    random = np.random.default_rng(0)
    poses = pose_from(rotation_matrices(random.normal(0, 0.2, (4, 3))), random.normal(0, 1, (4, 3)))
    frames = [0, 10, 20, 30]
    first = moved_anchors([], {2: 1}, frames, poses)
    assert [(anchor.frame, anchor.reference) for anchor in first] == [(20, 1)]
    both = moved_anchors(first, {1: 0}, frames, poses)  # its reference is left out in turn
    assert [(anchor.frame, anchor.reference) for anchor in both] == [(10, 0), (20, 0)]
    for anchor, pose in zip(both, poses[1:3], strict=True):
        np.testing.assert_allclose(compose(poses[0], anchor.pose), pose, atol=1e-12)
        assert np.allclose(anchor.pose, inverse(poses[0]) @ pose)
