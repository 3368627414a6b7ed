"""When a lost camera counts as found: at once where there is next to no doubt, else after some frames that agree."""

import math
from dataclasses import replace

import pytest
import torch

from spslam.slam.fit import Fit
from spslam.slam.recovery.pose_confidence import PoseConfidenceModel
from spslam.slam.recovery.recovery import CONSISTENT_FRAMES, Recovery, _by_features
from spslam.slam.recovery.tracked_frame import TrackedFrame
from spslam.slam.tracker import Tracker
from tests.system.sequences import Recorded, settings

# Doubts after loss of some 0.001, 0.05 and 0.6.
CERTAIN = Fit(0.5, 0.98, 0.85, 0.012, 1.0, 0.5, 0.005)
LIKELY = replace(CERTAIN, mean_robust_weight=0.5, inlier_share=0.7)
UNLIKELY = replace(CERTAIN, mean_robust_weight=0.3, inlier_share=0.5, min_eigenvalue=0.003)


@pytest.fixture(scope="module")
def recovery():
    config, camera, confidence = settings(), Recorded(1).camera, PoseConfidenceModel.load()
    return Recovery(config, camera, Tracker(config, camera, confidence.score_kernel_m), confidence)


def found_again(recovery, fit, consistent_before):
    tracked = TrackedFrame(torch.zeros(7), 8, fit, error_probability=0.0, lost=False)
    return recovery._accept_anywhere(tracked, consistent_before)


def test_without_doubt_it_is_found_at_once(recovery):
    result = found_again(recovery, CERTAIN, 0)
    assert (result.lost, result.consistent_frames) == (False, 0)
    assert result.error_probability < 0.02


@pytest.mark.parametrize("before", range(CONSISTENT_FRAMES + 1))
def test_likely_poses_must_agree_for_some_frames(recovery, before):
    result = found_again(recovery, LIKELY, before)
    assert 0.02 < result.error_probability < 0.1
    assert result.lost == (before < CONSISTENT_FRAMES - 1)
    assert result.consistent_frames == (before + 1 if result.lost else 0)


@pytest.mark.parametrize("far", [{"prediction_error_cm": 30.0}, {"prediction_error_deg": 10.0}])
def test_poses_apart_do_not_agree(recovery, far):
    result = found_again(recovery, replace(LIKELY, **far), CONSISTENT_FRAMES + 1)
    assert (result.lost, result.consistent_frames) == (True, 1)


def test_a_plane_agrees_with_itself_anywhere(recovery):
    plane = replace(LIKELY, mean_robust_weight=0.65, min_eigenvalue=0.002)
    result = found_again(recovery, plane, CONSISTENT_FRAMES + 1)
    assert 0.02 < result.error_probability < 0.1
    assert (result.lost, result.consistent_frames) == (True, 0)


def test_an_unlikely_pose_ends_the_row(recovery):
    result = found_again(recovery, UNLIKELY, CONSISTENT_FRAMES + 1)
    assert result.error_probability > 0.1
    assert (result.lost, result.consistent_frames) == (True, 0)


def with_features(found, inliers, share=1.0, lost=False):
    fit = replace(CERTAIN, feature_inliers=inliers, feature_share=share)
    return TrackedFrame(torch.zeros(7), 8, fit, error_probability=found, lost=lost)


@pytest.mark.parametrize(
    ("other", "decides"),
    [
        (with_features(0.1, 130), True),
        (with_features(0.1, 110), False),  # next to as many agree with both
        (with_features(0.1, 130, share=math.nan), False),  # colors are not where depth is
        (with_features(0.9, 130, lost=True), False),
    ],
)
def test_far_more_image_features_decide_between_trusted_poses(other, decides):
    likeliest = with_features(0.05, 100)
    assert _by_features(likeliest, [likeliest, other]) is (other if decides else likeliest)


def test_few_image_features_decide_nothing():
    likeliest, other = with_features(0.05, 20), with_features(0.1, 50)
    assert _by_features(likeliest, [likeliest, other]) is likeliest
