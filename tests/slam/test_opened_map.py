"""What a run in an opened map keeps of it."""

import numpy as np
import pytest
import torch

from spslam.camera import Camera
from spslam.config import load_config
from spslam.slam.graph.archive import KeyframeArchive, Recording
from spslam.slam.graph.edges import Link
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
