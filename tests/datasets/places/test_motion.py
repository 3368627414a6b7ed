"""Motions: smooth poses at any time, as fast as named."""

import numpy as np
import pytest

from spslam.datasets.places import MOTIONS, Motion, make_place
from spslam.geometry import rotation_angle

RATE_HZ = 100.0
TIMES = np.arange(0, 60, 1 / RATE_HZ)


def motion_of(style, name="apartment", seed=0):
    place = make_place(name, seed)
    return Motion(place.route, style, seed, place.pace)


def speeds(poses):
    """m/s and deg/s between successive poses."""
    meters = np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1)
    turns = rotation_angle(np.swapaxes(poses[:-1, :3, :3], 1, 2) @ poses[1:, :3, :3])
    return meters * RATE_HZ, np.degrees(turns) * RATE_HZ


@pytest.mark.parametrize("style", MOTIONS)
def test_poses_are_smooth_rotations(style):
    poses = motion_of(style).poses(TIMES)
    eye = poses[:, :3, :3] @ np.swapaxes(poses[:, :3, :3], 1, 2)
    np.testing.assert_allclose(eye, np.tile(np.eye(3), (len(poses), 1, 1)), atol=1e-12)
    assert (poses[:, 2, 1] < 0).all()  # the camera's y axis points down
    meters, degrees = speeds(poses)
    assert meters.max() < 2.0
    assert degrees.max() < 205
    # Acceleration has no steps: speed changes little within 10 ms.
    assert np.abs(np.diff(meters)).max() < 0.25
    assert np.abs(np.diff(degrees)).max() < 30


def test_motions_are_what_their_names_say():
    found = {style: speeds(motion_of(style, "arcade").poses(TIMES)) for style in MOTIONS}
    assert 0.3 < np.median(found["handheld"][0]) < 0.8
    assert 0.8 < np.median(found["walking"][0]) < 1.5
    assert found["handheld"][1].max() < 60
    assert found["fast_turns"][1].max() > 130
    standing = found["stop_and_go"][0] < 0.05
    assert 0.15 < standing.mean() < 0.5
    assert (found["walking"][0] > 0.3).all()


def test_walking_bobs_with_each_step():
    height = motion_of("walking").poses(TIMES)[:, 2, 3]
    spectrum = np.abs(np.fft.rfft(height - height.mean()))
    frequency = np.fft.rfftfreq(len(height), 1 / RATE_HZ)[spectrum.argmax()]
    assert 1.6 < frequency < 2.0
    assert 0.02 < np.ptp(height) < 0.1


@pytest.mark.parametrize("style", MOTIONS)
def test_one_time_gives_one_pose(style):
    motion = motion_of(style)
    times = np.array([-0.5, 0.0, 3.7, 500.0])
    poses = motion.poses(times)
    for time, pose in zip(times, poses, strict=True):
        np.testing.assert_array_equal(motion.pose(time), pose)
    assert np.isfinite(poses).all()


def test_rounds_follow_each_other_without_a_jump():
    motion = motion_of("handheld", "room")
    meters, degrees = speeds(motion.poses(np.arange(0, 4 * motion.round_s, 1 / RATE_HZ)))
    assert meters.max() < 1
    assert degrees.max() < 60


def test_a_round_comes_back():
    place = make_place("arcade", 0)
    route = place.route
    start, end = route.at(np.array([0.0])), route.at(np.array([route.effort_m]))
    np.testing.assert_allclose(start[0], end[0], atol=1e-9)
    turned = (end[1] - start[1]) / (2 * np.pi)
    assert turned == pytest.approx(np.round(turned), abs=1e-9)
    assert abs(turned) == pytest.approx(1)


def test_seeds_differ():
    assert not np.allclose(motion_of("handheld", seed=0).pose(1.0), motion_of("handheld", seed=1).pose(1.0))


def test_unknown_style():
    with pytest.raises(ValueError, match="Motion: style must be one of handheld, .*, got flying"):
        motion_of("flying")
