"""When a lost camera counts as found: at once where there is next to no doubt, else after some frames that agree."""

from dataclasses import dataclass, replace

import pytest
import torch

from spslam.slam.loss_decision import Fit
from spslam.slam.tracker import AGREEING, Tracker, TrackingResult
from tests.system.sequences import Recorded, settings

# Doubts after loss of some 0.001, 0.05 and 0.6.
CERTAIN = Fit(0.5, 0.98, 0.85, 0.012, 1.0, 0.5, 0.005)
LIKELY = replace(CERTAIN, support=0.5, inlier_share=0.7)
UNLIKELY = replace(CERTAIN, support=0.3, inlier_share=0.5, information=0.003)


@dataclass
class Before:
    agreeing: int


@pytest.fixture(scope="module")
def tracker():
    return Tracker(settings(), Recorded(1).camera)


def found_again(tracker, fit, agreeing):
    result = TrackingResult(torch.zeros(7), 8, fit, lost=False)
    return tracker._found_again(result, Before(agreeing))


def test_without_doubt_it_is_found_at_once(tracker):
    result = found_again(tracker, CERTAIN, 0)
    assert (result.lost, result.agreeing) == (False, 0)
    assert result.fit.doubt < 0.02


@pytest.mark.parametrize("before", range(AGREEING + 1))
def test_likely_poses_must_agree_for_some_frames(tracker, before):
    result = found_again(tracker, LIKELY, before)
    assert 0.02 < result.fit.doubt < 0.1
    assert result.lost == (before < AGREEING - 1)
    assert result.agreeing == (before + 1 if result.lost else 0)


@pytest.mark.parametrize("far", [{"jump_cm": 30.0}, {"jump_deg": 10.0}])
def test_poses_apart_do_not_agree(tracker, far):
    result = found_again(tracker, replace(LIKELY, **far), AGREEING + 1)
    assert (result.lost, result.agreeing) == (True, 1)


def test_a_plane_agrees_with_itself_anywhere(tracker):
    plane = replace(LIKELY, support=0.65, information=0.002)
    result = found_again(tracker, plane, AGREEING + 1)
    assert 0.02 < result.fit.doubt < 0.1
    assert (result.lost, result.agreeing) == (True, 0)


def test_an_unlikely_pose_ends_the_row(tracker):
    result = found_again(tracker, UNLIKELY, AGREEING + 1)
    assert result.fit.doubt > 0.1
    assert (result.lost, result.agreeing) == (True, 0)
