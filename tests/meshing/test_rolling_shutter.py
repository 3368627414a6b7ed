"""Frames of a rolling shutter are rectified for meshes."""

import numpy as np
import pytest

from spslam.datasets.places import Capture, PlacesDataset
from spslam.meshing.rolling_shutter import FrameReadout
from spslam.run.mesh import measured_readout_s, posed_frames
from spslam.trajectory import Trajectory

FRAMES, READOUT_S = 24, 0.03


def recorded(readout_ms=0.0):
    capture = Capture(width=160, height=120, rolling_shutter_ms=readout_ms)
    return PlacesDataset("apartment", "fast_turns", "exact", FRAMES, 5, capture=capture)


@pytest.fixture(scope="module")
def bent():
    return recorded(1e3 * READOUT_S)


@pytest.fixture(scope="module")
def straight():
    return recorded()


def path(dataset, lost=()):
    return Trajectory(dataset.timestamps(), dataset.poses(), np.isin(np.arange(FRAMES), lost))


def off_m(depth, wanted):
    """Median difference, m."""
    return float(np.median(np.abs(depth - wanted)))


def fastest(dataset):
    """The frame before which the camera turns most."""
    poses = dataset.poses()
    turns = [np.trace(poses[i - 1][:3, :3].T @ poses[i][:3, :3]) for i in range(1, FRAMES)]
    return int(np.argmin(turns)) + 1


def test_frames_are_as_of_one_moment(bent, straight):
    frames, index = posed_frames(bent, path(bent), READOUT_S), fastest(bent)
    read, found, wanted = bent[index], frames[index], straight[index]
    # Depth is of the nearest pixel and the camera does not turn evenly, so some of it is left.
    assert off_m(found.depth, wanted.depth) < 0.25 * off_m(read.depth, wanted.depth)
    colors = [np.abs(each.color.astype(int) - wanted.color).mean() for each in (found, read)]
    assert colors[0] < 0.6 * colors[1]
    np.testing.assert_array_equal(frames.depth(index), found.depth)


@pytest.mark.parametrize("gone", ["before", "after"])
def test_the_velocity_is_from_the_frames_that_are_known(bent, straight, gone):
    index = fastest(bent)
    lost = [index - 1] if gone == "before" else [index + 1]
    readout = FrameReadout(READOUT_S, path(bent, lost), np.arange(FRAMES))
    found, wanted = readout.rectified(index, bent[index], bent.camera), straight[index]
    assert off_m(found.depth, wanted.depth) < 0.5 * off_m(bent[index].depth, wanted.depth)


def test_frames_stay_as_they_are_where_nothing_is_known(bent):
    index, every = fastest(bent), np.arange(FRAMES)
    alone = FrameReadout(READOUT_S, path(bent, [index - 1, index + 1]), every)
    slow = FrameReadout(READOUT_S, Trajectory(20 * bent.timestamps(), bent.poses()), every)
    still = FrameReadout(READOUT_S, Trajectory(bent.timestamps(), np.repeat(bent.poses()[:1], FRAMES, 0)), every)
    absent = FrameReadout(READOUT_S, path(bent), np.full(FRAMES, -1))
    frame = bent[index]
    for readout in (alone, slow, still, absent):
        assert readout.rectified(index, frame, bent.camera) is frame
        assert readout.rectified_depth(index, frame.depth, bent.camera) is frame.depth
    assert posed_frames(bent, path(bent)).readout is None


def test_a_frame_without_depth_is_rectified(bent):
    index = fastest(bent)
    readout = FrameReadout(READOUT_S, path(bent), np.arange(FRAMES))
    assert not readout.rectified_depth(index, np.zeros((120, 160), np.float32), bent.camera).any()


@pytest.mark.parametrize("metrics", [{}, {"readout_ms": None}, {"readout_ms": "26"}, {"readout_ms": 1e9}])
def test_a_readout_that_is_not_said_is_none(metrics):
    assert measured_readout_s(metrics) == 0.0


def test_a_readout_is_in_seconds():
    assert measured_readout_s({"readout_ms": 26.0}) == pytest.approx(0.026)
