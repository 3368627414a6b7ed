"""When a lost camera counts as found: at once where there is next to no doubt, else after some frames that agree."""

import math
from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch

from spslam.slam.fit import Fit
from spslam.slam.recovery.doubtful_frame import preferred_by_brightness, preferred_by_features
from spslam.slam.recovery.pose_confidence import PoseConfidenceModel
from spslam.slam.recovery.pose_judge import PoseJudge
from spslam.slam.recovery.recovery import CONSISTENT_FRAMES, Recovery
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


def found_again(recovery, fit, consistent_before, colors_are_registered=True):
    tracked = TrackedFrame(torch.zeros(7), 8, fit, error_probability=0.0, lost=False)
    return recovery._accept_anywhere(tracked, consistent_before, colors_are_registered)


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


@pytest.mark.parametrize(("correlation", "is_lost"), [(0.79, True), (0.84, True), (0.86, False), (math.nan, False)])
def test_a_place_that_fits_but_looks_different_is_another_one(recovery, correlation, is_lost):
    """Bays of an arcade: surface fits within millimeters, and frame by frame; 111 features of arches had agreed too."""
    for fit in (CERTAIN, replace(CERTAIN, feature_inliers=111, feature_share=0.96), LIKELY):
        result = found_again(recovery, replace(fit, brightness_correlation=correlation), CONSISTENT_FRAMES + 1)
        assert result.error_probability < 0.1
        assert (result.lost, result.consistent_frames) == (is_lost, 0)


def test_colors_that_are_not_where_depth_is_tell_no_places_apart(recovery):
    fit = replace(CERTAIN, brightness_correlation=0.75)
    assert not found_again(recovery, fit, 0, colors_are_registered=False).lost


@pytest.mark.parametrize("far", [{"prediction_error_cm": 30.0}, {"prediction_error_deg": 10.0}])
def test_poses_apart_do_not_agree(recovery, far):
    result = found_again(recovery, replace(LIKELY, **far), CONSISTENT_FRAMES + 1)
    assert (result.lost, result.consistent_frames) == (True, 1)


def test_a_plane_agrees_with_itself_anywhere(recovery):
    plane = replace(LIKELY, mean_robust_weight=0.65, min_eigenvalue=0.002)
    result = found_again(recovery, plane, CONSISTENT_FRAMES + 1)
    assert 0.02 < result.error_probability < 0.1
    assert (result.lost, result.consistent_frames) == (True, 0)


@pytest.mark.parametrize(
    ("inliers", "share", "rays", "is_lost"),
    [(26, 0.8, 0, True), (70, 0.9, 0, False), (26, 0.9, 100, False), (70, 0.7, 0, True), (70, math.nan, 0, True)],
)
def test_where_surface_leaves_a_direction_free_many_features_must_agree(recovery, inliers, share, rays, is_lost):
    """However certain it seems: 26 features had agreed with a pose that was 9 cm off along a wall."""
    fit = replace(CERTAIN, mean_robust_weight=0.9, min_eigenvalue=0.0025)
    fit = replace(fit, feature_inliers=inliers, feature_share=share, feature_rays=rays)
    result = found_again(recovery, fit, CONSISTENT_FRAMES + 1)
    assert result.error_probability < 0.02
    assert (result.lost, result.consistent_frames) == (is_lost, 0)


def test_an_unlikely_pose_ends_the_row(recovery):
    result = found_again(recovery, UNLIKELY, CONSISTENT_FRAMES + 1)
    assert result.error_probability > 0.1
    assert (result.lost, result.consistent_frames) == (True, 0)


def with_features(found, inliers, share=1.0, lost=False, weight=CERTAIN.mean_robust_weight):
    fit = replace(CERTAIN, mean_robust_weight=weight, feature_inliers=inliers, feature_share=share)
    return TrackedFrame(torch.zeros(7), 8, fit, error_probability=found, lost=lost)


@pytest.mark.parametrize(
    ("other", "times", "decides"),
    [
        (with_features(0.1, 130), 1.2, True),
        (with_features(0.1, 110), 1.2, False),  # next to as many agree with both
        (with_features(0.1, 109), 1.0, False),  # no more than agree by chance
        (with_features(0.1, 112), 1.0, True),
        (with_features(0.1, 90), 1.0, False),
        (with_features(0.1, 112, weight=0.6), 1.0, False),  # surface agrees less than the features more
        (with_features(0.1, 130, weight=0.6), 1.2, False),
        (with_features(0.1, 98, weight=0.98), 1.0, True),
        (with_features(0.1, 130, share=math.nan), 1.0, False),  # colors are not where depth is
        (with_features(0.9, 130, lost=True), 1.0, False),
    ],
)
def test_surface_and_image_features_decide_between_trusted_poses(other, times, decides):
    likeliest = with_features(0.05, 100)
    assert preferred_by_features(likeliest, [likeliest, other], times) is (other if decides else likeliest)


@pytest.mark.parametrize(
    ("changes", "interval_s", "knows_speed", "lost"),
    [
        ({}, 0.0, True, False),  # the camera turns to what was not seen yet
        ({"feature_inliers": 40}, 0.0, True, True),
        ({"feature_share": 0.7}, 0.0, True, True),
        ({"feature_share": math.nan}, 0.0, True, True),  # colors are not where depth is
        ({"prediction_error_cm": math.nan}, 0.0, True, True),  # it may be anywhere, as where places are alike
        ({"prediction_error_cm": 30.0}, 0.0, True, True),  # it has jumped
        ({"prediction_error_deg": 10.0}, 0.0, True, True),
        ({"prediction_error_cm": 6.0, "prediction_error_deg": 5.0}, 0.1, True, True),
        ({"prediction_error_cm": 10.0, "prediction_error_deg": 5.0}, 0.15, True, False),  # it was carried on meanwhile
        ({"prediction_error_cm": 22.0, "prediction_error_deg": 5.0}, 0.15, True, True),
        ({"prediction_error_cm": 22.0, "prediction_error_deg": 5.0}, 0.15, False, False),  # as fast as before, maybe
        ({"prediction_error_cm": 6.0, "prediction_error_deg": 5.0}, 1 / 30, False, True),
        ({"prediction_error_cm": 31.0}, 0.4, True, True),
    ],
)
def test_off_the_map_image_features_hold_a_camera(changes, interval_s, knows_speed, lost):
    off = replace(CERTAIN, inlier_share=0.15, mean_robust_weight=0.1, feature_inliers=200, feature_share=1.0)
    tracked = TrackedFrame(torch.zeros(7), 8, replace(off, **changes), error_probability=0.0, lost=False)
    judge = PoseJudge(settings(), PoseConfidenceModel.load())
    assert judge.judged(tracked, SimpleNamespace(interval_s=interval_s, knows_speed=knows_speed)).lost == lost


@pytest.mark.parametrize(("share", "taken"), [(1.0, 1), (math.nan, 0)])
def test_of_results_that_are_one_pose_that_with_most_agreement_stands_for_all(recovery, monkeypatch, share, taken):
    """Where colors are where depth is; else the one of the best fit."""
    results = [
        replace(with_features(0.05, n, share), pose=torch.tensor([1.0, 0, 0, 0, x, 0, 0]))
        for n, x in ((100, 0.0), (140, 0.002))
    ]
    frame = SimpleNamespace(with_features=lambda fit, pose: fit)
    monkeypatch.setattr(recovery, "_verify", lambda frame, tracked: tracked)
    assert recovery._likeliest(frame, results).pose is results[taken].pose


def test_few_image_features_decide_nothing():
    likeliest, other = with_features(0.05, 20), with_features(0.1, 50)
    assert preferred_by_features(likeliest, [likeliest, other], 1.2) is likeliest


@pytest.mark.parametrize(
    ("changes", "lost", "decides"),
    [
        ({}, False, True),
        ({}, True, False),
        ({"mean_robust_weight": 0.75}, False, False),  # surface does not speak for it
        ({"brightness_correlation": 0.8}, False, False),  # nor does brightness
        ({"brightness_correlation": math.nan}, False, False),
    ],
)
def test_surface_and_brightness_decide_against_features(changes, lost, decides):
    """Features of frames that were found again some centimeters off agree with a pose that is off as well."""
    likeliest, other = with_features(0.01, 270, weight=0.76), with_features(0.02, 220, lost=lost, weight=0.8)
    likeliest = replace(likeliest, fit=replace(likeliest.fit, brightness_correlation=0.74))
    other = replace(other, fit=replace(other.fit, **{"brightness_correlation": 0.93, **changes}))
    assert preferred_by_brightness(likeliest, [likeliest, other]) is (other if decides else likeliest)


@pytest.mark.parametrize(("changes", "asks"), [({}, False), ({"prediction_error_cm": 40.0}, True)])
def test_a_camera_that_has_jumped_may_be_anywhere(recovery, monkeypatch, changes, asks):
    """A hall had 84 features alike 2.8 m from where the camera had jumped back to."""
    found = with_features(0.001, 200)
    found = replace(found, fit=replace(found.fit, **changes))
    asked = []
    monkeypatch.setattr(recovery, "_starts_at_last", lambda frame, first: (frame, []))
    monkeypatch.setattr(recovery, "_likeliest", lambda *args, **kwargs: found)
    monkeypatch.setattr(recovery, "_relocalize", lambda frame, candidates: asked.append(1) or found)
    history = SimpleNamespace(
        consecutive_lost_frames=0, consistent_frames=0, interval_s=1 / 30, steps=1.0, knows_speed=True
    )
    problem = SimpleNamespace(constraints=SimpleNamespace(reference=None))
    recovery._recover(problem, found, None, history, None)
    assert bool(asked) == asks


@pytest.mark.parametrize("lost", [False, True])
def test_where_features_move_a_pose_to_where_it_is_lost_it_is_recovered(recovery, monkeypatch, lost):
    tracked = replace(with_features(0.01, 200), equations=object())
    held, recovered = replace(tracked, lost=lost), replace(tracked, recovered=True)
    monkeypatch.setattr("spslam.slam.recovery.recovery.IcpAlignment", lambda *_: None)
    monkeypatch.setattr(
        "spslam.slam.recovery.recovery.DoubtfulFrame", lambda *_: SimpleNamespace(compared=lambda *_: None)
    )
    monkeypatch.setattr(recovery, "_image", lambda *_: SimpleNamespace(read=None))
    monkeypatch.setattr(recovery, "_anchors", lambda *_: [])
    monkeypatch.setattr(recovery, "_hold", lambda *_: (held, True))
    monkeypatch.setattr(recovery, "_recover", lambda *_: recovered)
    found = recovery._held(None, tracked, None, SimpleNamespace(last_row=lambda: 0), None)
    assert found is (recovered if lost else held)
