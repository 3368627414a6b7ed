"""Two components of keyframes: joined where they show the same place, left apart where they do not."""

import numpy as np
import pytest
import torch

from spslam.geometry import compose, inverse, pose_from
from spslam.pose_graph import rotation_matrices
from spslam.slam.graph import joining
from spslam.slam.graph.joining import MIN_LOOPS, Component, find_frame, find_joint
from spslam.slam.graph.keyframe import Keyframe
from spslam.slam.graph.registration import Registrar
from spslam.slam.pixels import sample_frame
from spslam.slam.state import SlamState
from tests.slam.graph.worlds import NOISE, keyframes, place

NUMBERS = tuple(range(0, 48, 4))
MOVED = pose_from(rotation_matrices(np.array([0.3, -1.2, 0.5])), np.array([4.0, -2.0, 1.0]))


def registrar(*components, **options):
    return Registrar({each.camera: NOISE for one in components for each in one.keyframes}, 0, **options)


@pytest.fixture(scope="module")
def room():
    return Component(*keyframes("room", 300, NUMBERS))


def part(component, rows, moved=None):
    poses = component.poses[rows]
    return Component([component.keyframes[row] for row in rows], poses if moved is None else compose(moved, poses))


def test_components_of_one_place_are_joined(room):
    one, other = part(room, range(4, 12, 2), MOVED), part(room, range(1, 12, 2))
    joint = find_joint(registrar(room), one, other)
    assert not isinstance(joint, str)
    placed, true = compose(joint.pose, one.poses), compose(inverse(MOVED), one.poses)
    assert np.linalg.norm((placed - true)[:, :3, 3], axis=1).max() < 0.02
    assert len(joint.loops) >= MIN_LOOPS
    assert len({loop.source for loop in joint.loops}) > 1 and len({loop.target for loop in joint.loops}) > 1
    again = find_joint(registrar(room), one, other)
    assert again.pose.tobytes() == joint.pose.tobytes()


def test_other_places_are_left_apart(room):
    for name, frames, numbers in (("arcade", 400, tuple(range(0, 400, 40))), ("apartment", 60, (0, 12, 24, 36, 48))):
        other = Component(*keyframes(name, frames, numbers))
        reason = find_joint(registrar(room, other), room, other)
        assert isinstance(reason, str) and "\n" not in reason


def test_one_keyframe_is_not_enough(room):
    reason = find_joint(registrar(room), part(room, [5], MOVED), part(room, range(0, 12, 2)))
    assert isinstance(reason, str)


def test_without_image_features_nothing_is_joined(room):
    assert "0 of their keyframes" in find_joint(registrar(room, features=False), room, room)


def test_frame_is_found_where_it_is(room):
    known, frame, pose = part(room, range(0, 12, 2)), room.keyframes[5], room.poses[5]
    found = find_frame(registrar(room), frame, known)
    assert np.linalg.norm((found - pose)[:3, 3]) < 0.02
    assert find_frame(registrar(room), frame, part(room, [4])) is None
    assert find_frame(registrar(room, features=False), frame, known) is None


def test_frame_of_another_place_is_not_found(room):
    other = Component(*keyframes("arcade", 400, tuple(range(0, 400, 40))))
    assert find_frame(registrar(room, other), room.keyframes[5], other) is None


def test_storeys_that_are_alike_are_told_apart_by_brightness(monkeypatch):
    """The same flight of stairs, one storey higher: features and surface fit, as they do where it is right."""
    numbers = (530, 545, 560, 2055, 2070)
    config, dataset = place("stairwell", 3000, "handheld", "dataset.width=320", "dataset.height=240")
    state = SlamState.start(config, dataset.camera, np.eye(4), None, torch.device("cpu"))
    frames = [Keyframe.of(i, sample_frame(dataset[i], dataset.camera, config), state.graph.camera) for i in numbers]
    both = Component(frames, dataset.poses()[list(numbers)])
    one, other = part(both, [3, 4]), part(both, [0, 1, 2])
    assert isinstance(find_joint(registrar(both), one, other), str)
    assert all(find_frame(registrar(both), frame, other) is None for frame in one.keyframes)
    monkeypatch.setattr(joining, "MIN_CORRELATION_ANYWHERE", 0.0)
    found = [find_frame(registrar(both), frame, other) for frame in one.keyframes]
    assert any(pose is not None for pose in found)
