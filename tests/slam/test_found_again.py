"""When a lost camera counts as found: at once where there is next to no doubt, else after some frames that agree."""

from dataclasses import dataclass, replace

import pytest
import torch

from spslam.slam.recovery.pose_confidence import Fit
from spslam.slam.tracker import AGREEING, Tracker, TrackingResult
from tests.system.sequences import Recorded, settings

# Doubts after loss of some 0.001, 0.05 and 0.6.
CERTAIN = Fit(0.5, 0.98, 0.85, 0.012, 1.0, 0.5, 0.005)
LIKELY = replace(CERTAIN, mean_robust_weight=0.5, inlier_share=0.7)
UNLIKELY = replace(CERTAIN, mean_robust_weight=0.3, inlier_share=0.5, min_eigenvalue=0.003)


@dataclass
class Before:
    consistent_frames: int


@pytest.fixture(scope="module")
def tracker():
    return Tracker(settings(), Recorded(1).camera)


def found_again(tracker, fit, consistent_frames):
    result = TrackingResult(torch.zeros(7), 8, fit, lost=False)
    return tracker._found_again(result, Before(consistent_frames))


def test_without_doubt_it_is_found_at_once(tracker):
    result = found_again(tracker, CERTAIN, 0)
    assert (result.lost, result.consistent_frames) == (False, 0)
    assert result.fit.error_probability < 0.02


@pytest.mark.parametrize("before", range(AGREEING + 1))
def test_likely_poses_must_agree_for_some_frames(tracker, before):
    result = found_again(tracker, LIKELY, before)
    assert 0.02 < result.fit.error_probability < 0.1
    assert result.lost == (before < AGREEING - 1)
    assert result.consistent_frames == (before + 1 if result.lost else 0)


@pytest.mark.parametrize("far", [{"prediction_error_cm": 30.0}, {"prediction_error_deg": 10.0}])
def test_poses_apart_do_not_agree(tracker, far):
    result = found_again(tracker, replace(LIKELY, **far), AGREEING + 1)
    assert (result.lost, result.consistent_frames) == (True, 1)


def test_a_plane_agrees_with_itself_anywhere(tracker):
    plane = replace(LIKELY, mean_robust_weight=0.65, min_eigenvalue=0.002)
    result = found_again(tracker, plane, AGREEING + 1)
    assert 0.02 < result.fit.error_probability < 0.1
    assert (result.lost, result.consistent_frames) == (True, 0)


def test_an_unlikely_pose_ends_the_row(tracker):
    result = found_again(tracker, UNLIKELY, AGREEING + 1)
    assert result.fit.error_probability > 0.1
    assert (result.lost, result.consistent_frames) == (True, 0)
