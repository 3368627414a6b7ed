"""People on the camera's way: where they are, what they hide, and that they are no part of a place."""

import pickle

import numpy as np
import pytest

from spslam.datasets.places import Capture, PlacesDataset
from spslam.errors import DatasetError

SIZE = {"width": 96, "height": 72}


def walked(people, place="room", seed=5, **capture):
    return PlacesDataset(place, "walking", "exact", 300, seed, capture=Capture(**SIZE, **capture), people=people)


@pytest.mark.parametrize("readout_ms", [0, 25])
def test_any_order_gives_the_same_bytes(readout_ms):
    data = walked(3, rolling_shutter_ms=readout_ms, color_delay_ms=8)
    frames = [data[index] for index in (0, 40, 80)]
    again = pickle.loads(pickle.dumps(data))
    for frame in reversed(frames):
        assert again[frame.index].color.tobytes() == frame.color.tobytes()
        assert again[frame.index].depth.tobytes() == frame.depth.tobytes()


def test_they_hide_what_is_behind_them():
    empty, full = walked(0), walked(3)
    shares = []
    for index in range(0, 300, 30):
        before, after = empty[index], full[index]
        hidden = after.depth != before.depth
        assert (after.depth <= before.depth).all()
        np.testing.assert_array_equal(after.color[~hidden], before.color[~hidden])
        np.testing.assert_array_equal(after.pose, before.pose)
        shares.append(hidden.mean())
    assert 0.05 < np.mean(shares) < 0.6
    assert np.ptp(shares) > 0.1


def test_they_move_and_stand():
    data = walked(2, "hall")
    times = np.arange(0, 20, 0.1)
    for number, parts in enumerate(data._people._people):
        places = data._people._poses(number, parts[0].swing, times)[:, :3, 3]
        speeds = np.linalg.norm(np.diff(places, axis=0), axis=1) / 0.1
        assert speeds.max() < 5
        assert (speeds < 1e-6).any()
        assert (speeds > 0.5).any()


def test_they_are_no_part_of_the_place():
    points = np.random.default_rng(0).uniform(-1, 1, (100, 3))
    np.testing.assert_array_equal(walked(3).surface.signed_distance(points), walked(0).surface.signed_distance(points))


def test_what_does_not_fit_is_refused():
    with pytest.raises(DatasetError, match="dataset.people must be from 0 to 8, got 9"):
        walked(9)
    with pytest.raises(DatasetError, match="dataset.people must be 0 at a desk"):
        walked(1, "desk")
