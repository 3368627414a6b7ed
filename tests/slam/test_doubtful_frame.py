"""What image features say of a pose where the earlier frames that they were matched with contradict one another."""

from types import SimpleNamespace

import numpy as np
import pytest

from spslam.slam.fit import Fit
from spslam.slam.recovery.doubtful_frame import DoubtfulFrame
from spslam.slam.recovery.sliding import WEAK_EIGENVALUE


class Features:
    """Of an image: so many of each earlier frame's agree, whatever the pose."""

    def of_color(self, pose):
        return pose

    def inliers(self, matches, at, late_px=0.0):
        return matches.found

    def ray_inliers(self, matches, at):
        return 0


def frame_with(*agreeing_and_found, registration_px=0.0):
    matches = tuple(SimpleNamespace(agreeing=agreeing, found=found) for agreeing, found in agreeing_and_found)
    problem = SimpleNamespace(constraints=SimpleNamespace(noise_numbers=(0.0, 0.0, 0.0, registration_px**2)))
    return DoubtfulFrame(problem, None, None, None, Features(), matches)


def share(frame, min_eigenvalue):
    return frame.with_features(Fit(min_eigenvalue=min_eigenvalue), np.eye(4)).feature_share


def test_where_surface_leaves_a_direction_free_every_earlier_frame_counts():
    """All but the one of most features may have slid along it together."""
    assert share(frame_with((344, 344), (157, 1)), 0.9 * WEAK_EIGENVALUE) == pytest.approx(1 / 157)


def test_where_surface_holds_the_pose_the_frame_of_most_features_decides():
    """An earlier frame whose own pose is off must not have the camera lost: it would contradict any pose."""
    assert share(frame_with((157, 1), (344, 340)), WEAK_EIGENVALUE) == pytest.approx(340 / 344)
    assert share(frame_with((157, 157), (344, 10)), WEAK_EIGENVALUE) == pytest.approx(10 / 344)


def test_frames_with_few_features_and_colors_elsewhere_tell_nothing():
    assert share(frame_with((344, 344), (100, 0)), 0.0) == 1.0
    assert np.isnan(share(frame_with((344, 344), registration_px=1.0), 1.0))
    assert np.isnan(share(frame_with(), 1.0))
