"""Overlapping parts of one recording joined: by the frames that both know, else by image features."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from spslam.geometry import compose, inverse, pose_from
from spslam.pose_graph import rotation_matrices
from spslam.slam.graph.archive import KeyframeArchive, Recording
from spslam.slam.graph.edges import GraphEdge, Link, LoopDecision
from spslam.slam.graph.keyframe_graph import WEAK_INFORMATION
from spslam.slam.graph.parts import Part, join_parts, whole_recording
from spslam.slam.graph.registration import Registrar
from spslam.trajectory import Trajectory
from tests.slam.graph.worlds import NOISE, keyframes, place

NUMBERS = tuple(range(0, 48, 4))
MOVED = pose_from(rotation_matrices(np.array([0.3, -1.2, 0.5])), np.array([4.0, -2.0, 1.0]))
INFORMATION = 100 * WEAK_INFORMATION


@pytest.fixture(scope="module")
def world():
    frames, _ = keyframes("room", 300, NUMBERS)
    return frames, place("room", 300)[1]


def part(world, begin, end, moved=None, lost=()):
    """Frames begin to end of the room, with exact poses in a world of its own."""
    frames, dataset = world
    poses = dataset.poses()[begin:end]
    poses = poses if moved is None else compose(moved, poses)
    is_lost = np.isin(np.arange(begin, end), list(lost))
    trajectory = Trajectory(dataset.timestamps()[begin:end], poses, is_lost)
    own = [frame for frame in frames if begin <= frame.frame < end and frame.frame not in lost]
    at = [poses[frame.frame - begin] for frame in own]
    count = len(own)
    steps = [np.eye(4), *(compose(inverse(at[i - 1]), at[i]) for i in range(1, count))]
    archive = KeyframeArchive(
        [Recording("room", {}, dataset.camera, trajectory)],
        [frame.changed(frame=frame.frame - begin) for frame in own],
        [Link(step, False) for step in steps],
        torch.zeros(count, 5, 3, dtype=torch.int32),
        [GraphEdge("tracked", i, i - 1, steps[i], INFORMATION) for i in range(1, count)],
        {(i, i - 1) for i in range(1, count)},
        {own[0].camera: NOISE},
    )
    return Part(archive, np.arange(begin, end))


def registrar(one, **options):
    return Registrar(dict(one.archive.noise), 0, **options)


def error_m(joined, world):
    return np.abs((joined.trajectory.poses - world[1].poses()[joined.indices])[:, :3, 3]).max()


def test_two_parts_become_one(world):
    first, second = part(world, 0, 30), part(world, 18, 48, MOVED)
    joined = join_parts(first, second, 24, registrar(first))
    assert joined.indices.tolist() == list(range(48))
    assert joined.archive.rows.tolist() == list(NUMBERS)
    assert error_m(joined, world) < 0.01
    across = {edge.kind for edge in joined.archive.edges if edge.source >= 6 > edge.target}
    assert across >= {"tracked", "covisible"}
    again = join_parts(first, second, 24, registrar(first))
    assert again.trajectory.poses.tobytes() == joined.trajectory.poses.tobytes()
    # The parts are as they were.
    assert len(first.indices) == len(second.indices) == 30


def test_features_need_not_be_there(world):
    """Frames that both know say where the parts are, as along bare walls."""
    first, second = part(world, 0, 30), part(world, 18, 48, MOVED)
    assert error_m(join_parts(first, second, 24, registrar(first, features=False)), world) < 0.01


def test_without_a_frame_that_both_know_features_say_it(world):
    first, second = part(world, 0, 24), part(world, 24, 48, MOVED)
    joined = join_parts(first, second, 24, registrar(first))
    assert joined.indices.tolist() == list(range(48)) and error_m(joined, world) < 0.03
    reason = join_parts(first, second, 24, registrar(first, features=False))
    assert reason.startswith("the camera is known in 0 frames that they share, 3 must be, and 0 of their keyframes")


def test_poses_that_contradict_are_no_proof(world):
    """Of frames whose poses say different things nothing is taken; the features are asked."""
    first, second = part(world, 0, 30), part(world, 18, 48, MOVED)
    wrong = second.trajectory.poses.copy()
    wrong[:12, :3, 3] += np.random.default_rng(0).normal(size=(12, 3))
    recording = replace(second.archive.recordings[0], trajectory=Trajectory(second.trajectory.timestamps, wrong))
    shifted = Part(replace(second.archive, recordings=[recording]), second.indices)
    joined = join_parts(first, shifted, 30, registrar(first))
    assert not isinstance(joined, str) and error_m(joined, world) < 0.03


def test_a_part_without_keyframes_of_its_own_follows(world):
    first, second = part(world, 0, 30), part(world, 18, 32, MOVED)
    joined = join_parts(first, second, 29, registrar(first))
    assert joined.indices.tolist() == list(range(32)) and error_m(joined, world) < 1e-6
    assert len(joined.archive.keyframes) == 8


def test_lost_frames_stay_lost(world):
    first, second = part(world, 0, 30, lost=[22, 23]), part(world, 18, 48, MOVED, lost=[24, 25, 26])
    joined = join_parts(first, second, 24, registrar(first))
    assert np.flatnonzero(joined.trajectory.lost).tolist() == [22, 23, 24, 25, 26]
    named = whole_recording(joined, Recording("kitchen", {"dataset": {}}, world[1].camera, first.trajectory))
    assert named.recordings[0].name == "kitchen" and len(named.recordings[0].trajectory) == 48


def test_loops_of_frames_that_are_given_up_are_forgotten(world):
    first, second = part(world, 0, 28), part(world, 16, 48, MOVED)
    loops = tuple(LoopDecision(source, 4, False, "refused", 0.0) for source in (12, 24))
    joined = join_parts(replace(first, decisions=loops), second, 20, registrar(first))
    assert loops[0] in joined.decisions
    assert loops[1] not in joined.decisions
