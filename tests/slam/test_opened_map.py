"""What a run in an opened map keeps of it."""

import numpy as np
import pytest
import torch

from spslam.camera import Camera
from spslam.config import load_config
from spslam.slam.graph.archive import KeyframeArchive, Recording
from spslam.slam.graph.edges import Link
from spslam.slam.graph.joined import moved_recordings
from spslam.slam.graph.keyframe import Keyframe
from spslam.slam.opened_map import archive_of, put_keyframes
from spslam.slam.poses import pose_tensor
from spslam.slam.state import SlamState
from spslam.trajectory import Trajectory

CAMERA = Camera(64, 48, 60.0, 60.0, 31.5, 23.5)
OPENED, OWN = 4, 3


def pose(x):
    matrix = np.eye(4)
    matrix[0, 3] = x
    return matrix


def recording(name, first, count):
    """Frames at x = first, first + 1, ..."""
    poses = np.stack([pose(first + i) for i in range(count)])
    return Recording(name, {}, CAMERA, Trajectory(np.arange(count) + float(first), poses, np.zeros(count, bool)))


def keyframe(store, frame, x):
    """Of a frame at x, which its brightness tells."""
    size = (store.camera.camera.height, store.camera.camera.width)
    depth = torch.full(size, 1000, dtype=torch.int16).view(torch.uint16)
    return Keyframe(frame, depth, torch.full(size, x, dtype=torch.uint8), store.camera)


def pixels(x):
    """Packed pixels of a frame at x, at a depth of 1 m, whose last word tells it."""
    records = torch.zeros(8, 3, dtype=torch.int32)
    records[:, 1], records[:, 2] = torch.ones(8).view(torch.int32), x
    return records


@pytest.fixture
def state():
    """Keyframes of an opened map at x = 1 to 4, and own ones at 101 to 103."""
    state = SlamState.start(load_config("folder"), CAMERA, np.eye(4), None, torch.device("cpu"))
    store = state.graph
    keyframes = [keyframe(store, i, 1 + i) for i in range(OPENED)]
    archive = KeyframeArchive(
        [recording("opened", 1, OPENED)],
        keyframes,
        [Link(np.eye(4), False)] * OPENED,
        torch.stack([pixels(1 + i) for i in range(OPENED)]),
        [],
        set(),
        {store.camera: torch.zeros(4)},
        {},
    )
    put_keyframes(state, archive, archive.poses)
    for i in range(OWN):
        number, x = len(state.frames), 101 + i
        thumbnail = state.frames.depth_thumbnails[0].clone()
        state.frames.append(pose_tensor(pose(x), torch.device("cpu")), float(x), 0, False, thumbnail)
        state.pixels.add(pixels(x))
        store.add(keyframe(store, number, x), Link(np.eye(4), False))
    return state


@pytest.mark.parametrize("left_out", [{}, {2: 1}, {1: 0, 3: 2, 5: 4}])
def test_each_keyframe_keeps_its_own_pose_and_pixels(state, left_out):
    if left_out:
        state.graph.leave_out(left_out, state.frames.matrices()[state.graph.rows])
    archive = archive_of(state, recording("own", 101, OWN), {})
    frames = [1 + i for i in range(OPENED)] + [101 + i for i in range(OWN)]
    expected = [x for i, x in enumerate(frames) if i not in left_out]
    assert [int(each.intensity.flatten()[0]) for each in archive.keyframes] == expected
    assert archive.poses[:, 0, 3].tolist() == expected
    assert archive.records[:, 0, 2].tolist() == expected


def test_frames_follow_keyframes_that_were_left_out(state):
    """Those of the opened map at 3 and 4 follow that at 2, the own at 102 that at 101, whatever lies between."""
    state.graph.leave_out({2: 1, 5: 4}, state.frames.matrices()[state.graph.rows])
    state.graph.leave_out({2: 1}, state.frames.matrices()[state.graph.rows])
    archive = archive_of(state, recording("own", 101, OWN), {})
    assert archive.rows.tolist() == [0, 1, 4, 6] and archive.anchors.tolist() == [[2, 1], [3, 1], [5, 2]]
    turned = archive.poses
    turned[1:3, 1, 3] = [1.0, 5.0]  # the middle two are moved
    opened, own = moved_recordings(archive, turned)
    assert opened.trajectory.poses[:, 1, 3].tolist() == [0, 1, 1, 1]
    assert own.trajectory.poses[:, 1, 3].tolist() == [5, 5, 0]
    assert opened.trajectory.poses[:, 0, 3].tolist() == [1, 2, 3, 4]


def test_anchors_are_kept_by_maps_that_are_opened_again(state, tmp_path):
    state.graph.leave_out({2: 1, 5: 4}, state.frames.matrices()[state.graph.rows])
    archive = archive_of(state, recording("own", 101, OWN), {})
    archive.save(tmp_path / "keyframes.safetensors")
    known = KeyframeArchive.load(tmp_path / "keyframes.safetensors")
    assert known.anchors.tolist() == archive.anchors.tolist() == [[2, 1], [5, 3]]
    again = SlamState.start(load_config("folder"), CAMERA, np.eye(4), None, torch.device("cpu"))
    put_keyframes(again, known, known.poses)
    again.graph.leave_out({3: 2}, again.frames.matrices()[again.graph.rows])
    # Of the five keyframes the fourth, own frame 101, is left out now: what followed it follows the third.
    assert archive_of(again, None, {}).anchors.tolist() == [[2, 1], [4, 2], [5, 2]]


def test_noise_of_an_opened_map_is_restored_beside_that_of_the_same_camera(state):
    store = state.graph
    store.opened_noise[store.camera] = torch.tensor([1.0, 2, 3, 4])
    again = SlamState.start(load_config("folder"), CAMERA, np.eye(4), None, torch.device("cpu")).graph
    again.load_state_dict(store.tensors())
    assert again.noise.tolist() == store.noise.tolist()
    assert again.opened_noise[store.camera].tolist() == [1, 2, 3, 4]
