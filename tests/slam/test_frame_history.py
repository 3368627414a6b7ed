"""What tracking asks of the frames before: which are alike, and whether a pose looks through known surface."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from spslam.datasets.base import RgbdFrame
from spslam.geometry import matrix_to_pose7, pose7_to_matrix, rotation_angle
from spslam.slam.frame_history import MAX_STEPS, FrameHistory
from spslam.slam.pixels import sample_frame
from spslam.slam.poses import pose_matrix, pose_tensor
from spslam.slam.recovery.free_space import surface_counts, surface_shares
from spslam.slam.recovery.place_recognition import (
    MIN_SEPARATION,
    retrieve,
    thumbnail_difference,
    turned,
    turned_differences,
)
from spslam.slam.state import SlamState
from tests.system.sequences import Recorded, settings

FRAMES = 20
CPU = torch.device("cpu")
UNKNOWN_SHARE = 0.11


@pytest.fixture(scope="module")
def dataset():
    return Recorded(25)


@pytest.fixture(scope="module")
def pixels(dataset):
    return [sample_frame(dataset[i], dataset.camera, settings()) for i in range(25)]


def state_of(dataset, pixels, device=CPU, lost=()):
    """The first frames at their true poses, and no map."""
    state = SlamState.start(settings(), dataset.camera, np.eye(4), None, device)
    for i in range(FRAMES):
        moved = pixels[i].to(device)
        pose = pose_tensor(dataset.poses()[i], device)
        state.frames.append(pose, i / 30, i, i in lost, moved.depth_thumbnail)
        state.pixels.add(moved.records)
    return state


def test_the_next_frame_is_expected_at_the_same_interval(dataset, pixels):
    state = state_of(dataset, pixels)
    history = FrameHistory(state)
    assert history.seconds_since(FRAMES - 1) == pytest.approx(1 / 30)
    assert history.seconds_since(FRAMES - 4) == pytest.approx(4 / 30)
    assert history.interval_s == 0  # nobody says when it comes
    history.coming_s = FRAMES / 30 + 0.1
    assert history.interval_s == pytest.approx(1 / 30 + 0.1)
    history.coming_s = 0.0  # as where time does not go on
    assert history.interval_s == 0
    times = state.frames.depth_times
    times[-1] = times[-2]
    assert history.seconds_since(0) == np.inf
    times[-1], times[0] = 1.0, 2.0  # of an opened map
    assert history.seconds_since(0) == np.inf


def test_a_camera_moves_on_as_long_as_the_time_to_the_next_frame(dataset, pixels):
    state = state_of(dataset, pixels)
    history, times = FrameHistory(state), state.frames.depth_times
    assert history.steps == 1  # nobody says when it comes
    for intervals, steps in ((1.0, 1.0), (1.3, 1.0), (0.8, 1.0), (1.5, 1.5), (2.0, 2.0), (0.5, 0.5), (90.0, MAX_STEPS)):
        history.coming_s = float(times[-1]) + intervals / 30
        assert history.steps == pytest.approx(steps)
    times[-2] = times[-1]  # stamps that do not go on say nothing
    assert history.steps == 1


def test_without_timing_color_images_are_where_depth_images_are(dataset, pixels):
    state = state_of(dataset, pixels)
    state.noise.color_delay.fill_(0.01)
    history, rows = FrameHistory(state), [1, FRAMES - 1]
    at_depth = [pose_matrix(state.frames.poses[row]) for row in rows]
    moved, untimed = history.color_poses(rows), history.color_poses(rows, is_timed=False)
    assert all(np.array_equal(one, other) for one, other in zip(untimed, at_depth, strict=True))
    assert not any(np.array_equal(one, other) for one, other in zip(moved, at_depth, strict=True))


def test_stamps_of_one_moment_are_no_motion(dataset, pixels):
    """As 0.3 and 0.1 * 3 are, whose difference is less than the nanoseconds that ops count in."""
    state = state_of(dataset, pixels)
    history, last = FrameHistory(state), len(state.frames) - 1
    last_s = float(state.frames.timestamps[-1])
    state.frames.timestamps[:last] -= 1.0  # no earlier frame is near enough
    assert history.motion(last + 1, last_s + 5e-17 + 1e-16).row < 0
    assert history.motion(last + 1, last_s + 0.01).row == last


def test_difference_of_depth_images(device):
    depth_thumbnail = torch.tensor([[1.0, 2.0, 0.0, 0.0]], dtype=torch.float16, device=device)
    others = torch.tensor(
        [[[1.0, 2.0, 0.0, 0.0]], [[1.1, 2.0, 0.0, 0.0]], [[9.0, 0.0, 3.0, 0.0]], [[0.0, 0.0, 0.0, 0.0]]],
        dtype=torch.float16,
        device=device,
    )
    found = thumbnail_difference(depth_thumbnail, others).cpu()
    torch.testing.assert_close(
        found, torch.tensor([0.0, 0.5 * np.log(1.1), 0.2, 0.15], dtype=torch.float32), rtol=1e-2, atol=1e-3
    )
    assert thumbnail_difference(torch.zeros_like(depth_thumbnail), others[3:]).tolist() == [0]


def test_the_likest_frames_come_first_and_apart(dataset, pixels, device):
    history = FrameHistory(state_of(dataset, pixels, device))
    found = retrieve(history, pixels[8].to(device), 6, dataset.camera)
    poses = torch.stack([candidate.earlier.pose for candidate in found]).cpu()
    torch.testing.assert_close(found[0].start, found[0].earlier.pose)
    rows = [int((poses[i] - history._state.frames.poses.cpu()).norm(dim=1).argmin()) for i in range(len(found))]
    assert rows[0] == 8
    assert 1 <= len(rows) <= 6
    assert min(abs(a - b) for i, a in enumerate(rows) for b in rows[:i]) > MIN_SEPARATION if len(rows) > 1 else True
    assert retrieve(history, pixels[8].to(device), 0, dataset.camera) == []


@pytest.mark.parametrize(("yaw", "pitch"), [(16.0, 0.0), (-16.0, 0.0), (0.0, 12.0), (0.0, -12.0), (14.0, 11.0)])
def test_a_turned_camera_is_put_where_it_would_look_alike(dataset, yaw, pitch):
    """The same place, looking elsewhere: the start is nearer to the truth than the frame's own pose."""
    base = dataset.poses()[8]
    half = np.radians([yaw, pitch]) / 2
    turns = [
        np.array([np.cos(half[0]), 0, np.sin(half[0]), 0, 0, 0, 0]),
        np.array([np.cos(half[1]), np.sin(half[1]), *[0] * 5]),
    ]
    true = base @ pose7_to_matrix(turns[0]) @ pose7_to_matrix(turns[1])
    depth_thumbnails = []
    for pose in (base, true):
        color, depth = dataset.room.room.render(dataset.camera, pose)
        frame = RgbdFrame(0, 0.0, color, depth)
        depth_thumbnails.append(sample_frame(frame, dataset.camera, settings()).depth_thumbnail)
    shifts, differences = turned_differences(depth_thumbnails[1], depth_thumbnails[0][None])
    assert (0, 0) in shifts
    start = turned(pose_tensor(base, CPU), shifts[int(differences[:, 0].argmin())], dataset.camera).double().numpy()
    left = np.degrees(rotation_angle(pose7_to_matrix(start)[:3, :3].T @ true[:3, :3]))
    assert left < 0.6 * np.degrees(rotation_angle(base[:3, :3].T @ true[:3, :3]))
    np.testing.assert_allclose(start[4:], base[:3, 3], atol=1e-6)


def test_tiny_images_are_compared_too():
    shifts, differences = turned_differences(torch.ones(1, 1).half(), torch.ones(3, 1, 1).half())
    assert shifts == [(0, 0)]
    assert differences.tolist() == [[0, 0, 0]]


def test_lost_frames_are_not_offered(dataset, pixels):
    history = FrameHistory(state_of(dataset, pixels, lost={8, 18, 19}))
    assert history.is_lost
    assert history.consecutive_lost_frames == 2
    torch.testing.assert_close(history.last().pose, pose_tensor(dataset.poses()[17], CPU))
    assert not torch.equal(
        retrieve(history, pixels[8], 1, dataset.camera)[0].earlier.pose, pose_tensor(dataset.poses()[8], CPU)
    )


def test_without_a_known_frame_there_is_nothing(dataset, pixels):
    history = FrameHistory(state_of(dataset, pixels, lost=set(range(FRAMES))))
    assert history.last() is None
    assert retrieve(history, pixels[3], 5, dataset.camera) == []
    assert history.consecutive_lost_frames == FRAMES
    assert free_space_violation(history, pixels[3], pose_tensor(dataset.poses()[3], CPU), dataset.camera) == (
        UNKNOWN_SHARE,
        0,
    )


def free_space_violation(history, pixels, pose, camera):
    counts, _ = surface_counts(pixels, pose, history.poses, history.depth_thumbnails, history.compared_rows(), camera)
    return surface_shares(*counts.tolist(), UNKNOWN_SHARE)


def test_a_wrong_pose_looks_through_known_surface(dataset, pixels, device):
    history = FrameHistory(state_of(dataset, pixels, device))
    true, seen = dataset.poses()[21], pixels[21].to(device)
    through, occluded_share = free_space_violation(history, seen, pose_tensor(true, device), dataset.camera)
    assert through < 0.04
    assert occluded_share < 0.1
    ahead = true.copy()
    ahead[:3, 3] -= 0.5 * true[:3, 2]
    turned = true @ pose7_to_matrix(np.array([np.cos(0.2), 0, np.sin(0.2), 0, 0, 0, 0]))
    for wrong in (ahead, turned):
        assert free_space_violation(history, seen, pose_tensor(wrong, device), dataset.camera)[0] > 0.15


def test_what_hides_surface_is_told_from_a_wrong_pose(dataset, pixels):
    history = FrameHistory(state_of(dataset, pixels))
    frame = dataset[21]
    frame.depth[30:, :90] = 0.3
    seen = sample_frame(frame, dataset.camera, settings())
    through, occluded_share = free_space_violation(history, seen, pose_tensor(dataset.poses()[21], CPU), dataset.camera)
    assert through < 0.04
    assert occluded_share > 0.3


@pytest.mark.parametrize("is_known", [True, False])
def test_a_column_that_is_known_hides_nothing(dataset, is_known):
    """A column before a wall: seen from 4 cm further on in each frame, it is in front of another part of the wall."""
    camera = dataset.camera
    k = np.arange(6)
    poses = np.tile(np.eye(4), (6, 1, 1))
    poses[:, 0, 3] = 0.04 * k

    def seen(number, has_column):
        at = camera.cx + camera.fx * (0.3 - 0.04 * number)
        is_column = has_column & (np.abs(np.arange(camera.width) - at) < 0.15 * camera.fx)
        depth = np.tile(np.where(is_column, 1.0, 2.0), (camera.height, 1)).astype(np.float32)
        return sample_frame(replace(dataset[0], depth=depth), camera, settings())

    thumbnails = torch.stack([seen(number, is_known).depth_thumbnail for number in k[:5]])
    known = torch.from_numpy(matrix_to_pose7(poses[:5])).float()
    pose = pose_tensor(poses[5], CPU)
    counts, _ = surface_counts(seen(5, True), pose, known, thumbnails, torch.arange(5), camera)
    occluded_share = surface_shares(*counts.tolist(), UNKNOWN_SHARE)[1]
    assert occluded_share < 0.02 if is_known else occluded_share > 0.15
