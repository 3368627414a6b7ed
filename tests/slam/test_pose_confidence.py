"""The probability of a pose error: what raises it, what it is where nothing is known, and the measures behind it."""

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from spslam.config import read_shipped
from spslam.errors import ConfigError
from spslam.slam.fit import Fit, min_eigenvalue, prediction_error
from spslam.slam.recovery import pose_confidence
from spslam.slam.recovery.pose_confidence import MODEL_FILE, PoseConfidenceModel

GOOD = Fit(0.5, 0.95, 0.8, 0.012, 0.5, 0.3, 0.02)
MODEL = PoseConfidenceModel.load()


def error_probability(fit, **changes):
    return MODEL.error_probability(replace(fit, **changes))


def pose(vector, translation):
    x, y, z, w = Rotation.from_rotvec(vector).as_quat()
    return [w, x, y, z, *translation]


def test_a_good_fit_is_trusted_and_a_bad_one_is_not():
    assert error_probability(GOOD) < 0.001
    assert error_probability(Fit(1.2, 0.15, 0.06, 0.0005, 18.0, 5.0, 0.6)) > 0.999


WORSE = {
    "mean_robust_weight": 0.4,
    "min_eigenvalue": 0.001,
    "prediction_error_cm": 20.0,
    "prediction_error_deg": 10.0,
    "free_space_violation": 0.2,
    "brightness_correlation": 0.1,
}


@pytest.mark.parametrize("measure", WORSE)
def test_each_measure_raises_the_error_probability(measure):
    assert error_probability(GOOD, **{measure: WORSE[measure]}) > 2 * error_probability(GOOD)


def test_the_robust_weight_is_scaled_by_map_coverage():
    sparse = replace(GOOD, mean_robust_weight=0.3)
    assert error_probability(sparse, map_coverage=0.35) < 0.1 * error_probability(sparse)
    assert error_probability(sparse, map_coverage=0.95) == error_probability(sparse)
    assert error_probability(sparse, map_coverage=0.0) == error_probability(sparse)
    # A wrong pose has no larger weight on a map with holes.
    wrong = replace(GOOD, mean_robust_weight=0.05, min_eigenvalue=0.0005, free_space_violation=0.3)
    assert error_probability(wrong, prediction_error_cm=18.0, map_coverage=0.4) > 0.99


def test_where_features_confirm_a_pose_what_was_not_seen_yet_does_not_count():
    half = replace(GOOD, mean_robust_weight=0.4, inlier_share=0.5, prediction_error_cm=40.0, prediction_error_deg=20.0)
    confirmed = replace(half, feature_inliers=60, feature_share=0.9)
    assert error_probability(half) > 0.5 > 0.05 > error_probability(confirmed)
    everywhere = replace(confirmed, mean_robust_weight=0.8, inlier_share=1.0)
    assert error_probability(confirmed) == pytest.approx(error_probability(everywhere))
    for unsure in ({"feature_inliers": 15}, {"feature_share": 0.4}, {"feature_share": math.nan}):
        assert error_probability(confirmed, **unsure) > 0.1
    assert error_probability(confirmed, inlier_share=0.0, mean_robust_weight=0.0) > 0.5


def test_the_correlation_of_right_poses_makes_no_difference():
    for brightness_correlation in (0.71, 0.9, math.nan):
        assert error_probability(GOOD, brightness_correlation=brightness_correlation) == error_probability(GOOD)
    # A plain surface before the camera that fits a wall.
    wall = Fit(1.0, 0.95, 0.8, 0.002, math.nan, math.nan, 0.002)
    assert error_probability(wall) < 0.02
    assert error_probability(wall, brightness_correlation=0.0) > 0.5


def test_image_features_hold_what_surface_leaves_free():
    """A textured wall that fills the view: its eigenvalue is 0 whatever the pose."""
    wall = dict(min_eigenvalue=0.0, feature_share=0.95)
    assert error_probability(GOOD, **wall, feature_inliers=10) > 0.5
    assert error_probability(GOOD, **wall, feature_inliers=200) < 0.01
    slid = {**wall, "feature_share": 0.7}
    assert error_probability(GOOD, **slid, feature_inliers=200) > 0.5
    # Not where the camera may be anywhere: there may be such a wall elsewhere.
    anywhere = dict(prediction_error_cm=math.nan, prediction_error_deg=math.nan)
    assert error_probability(GOOD, **wall, **anywhere, feature_inliers=200) > 0.5
    # Nor where colors are not where depth is, which leaves the share unknown.
    assert error_probability(GOOD, **{**wall, "feature_share": math.nan}, feature_inliers=200) > 0.5


def test_what_lies_beyond_the_range_of_depth_holds_a_pose_with_what_does_not():
    wall = dict(min_eigenvalue=0.0, feature_share=0.95)
    assert error_probability(GOOD, **wall, feature_inliers=40, feature_rays=30) < 0.01
    assert error_probability(GOOD, **wall, feature_inliers=40, feature_rays=10) > 0.5
    # Rays alone don't: they do not tell how far the camera has gone.
    assert error_probability(GOOD, **wall, feature_inliers=10, feature_rays=500) > 0.5


def test_how_firmly_surface_holds_a_pose():
    """3 mm of a pixel are sqrt(300) times less of a pose along a direction of eigenvalue 1."""
    firm = Fit(residual_cm=0.1, min_eigenvalue=1.0)
    assert firm.deviation_m == pytest.approx(0.003 / math.sqrt(300))
    assert replace(firm, residual_cm=0.9, min_eigenvalue=0.01).deviation_m == pytest.approx(30 * firm.deviation_m)
    assert replace(firm, min_eigenvalue=0.0).deviation_m == math.inf
    assert Fit().deviation_m == math.inf


def test_features_that_hold_a_pose_speak_for_it():
    """Where the motion model was wrong, and where images are blurred."""
    far = dict(prediction_error_cm=20.0, prediction_error_deg=8.0, brightness_correlation=0.45)
    held = dict(feature_inliers=100, feature_share=0.9)
    assert error_probability(GOOD, **far) > 0.5
    assert error_probability(GOOD, **far, **held) == pytest.approx(
        error_probability(GOOD, **held, prediction_error_cm=0.0, prediction_error_deg=0.0)
    )
    for unsure in ({"feature_inliers": 40}, {"feature_share": 0.7}):
        assert error_probability(GOOD, **far, **{**held, **unsure}) > 0.1
    # A camera that has jumped may be anywhere, and places alike have features alike.
    for jump in ({"prediction_error_cm": 40.0}, {"prediction_error_deg": 25.0}):
        assert error_probability(GOOD, **{**far, **jump}, **held) > 0.5
    anywhere = dict(prediction_error_cm=math.nan, prediction_error_deg=math.nan, brightness_correlation=0.45)
    assert error_probability(GOOD, **anywhere, **held) > 0.5


def test_of_poses_that_features_hold_the_nearer_one_to_the_prediction_is_likelier():
    """Alone, both are as likely as where they were predicted."""
    held = replace(GOOD, feature_inliers=100, feature_share=0.9)
    near, far = (
        replace(held, prediction_error_cm=cm, prediction_error_deg=deg) for cm, deg in ((0.9, 0.1), (7.1, 0.7))
    )
    assert MODEL.error_probability(near) == MODEL.error_probability(far)
    assert MODEL.error_probability(near, compares=True) < MODEL.error_probability(far, compares=True)
    assert MODEL.error_probability(near, compares=True) > MODEL.error_probability(near)


def test_an_unknown_measure_counts_between_right_and_wrong():
    for name, wrong in (("free_space_violation", 0.3), ("prediction_error_cm", 50.0)):
        unknown = error_probability(GOOD, **{name: math.nan})
        assert error_probability(GOOD) < unknown < error_probability(GOOD, **{name: wrong})


def test_nothing_measured_is_no_number():
    assert math.isnan(error_probability(Fit()))
    assert 0 < error_probability(GOOD, min_eigenvalue=0.0) < 1


def test_extremes_stay_probabilities():
    assert error_probability(Fit(0, 0, 0, 0, 1e6, 180, 1)) == pytest.approx(1)
    assert error_probability(Fit(0, 1, 1, 1e3, 0, 0, 0)) == pytest.approx(0, abs=1e-6)


@pytest.mark.parametrize("degrees", [0.0, 1e-4, 5.0, 179.0, 180.0])
def test_prediction_error_is_distance_and_angle(degrees):
    axis = np.array([0.36, 0.48, 0.8])
    start = pose([0.3, -0.2, 0.1], [1, 2, 3])
    turned = (Rotation.from_rotvec(np.radians(degrees) * axis) * Rotation.from_rotvec([0.3, -0.2, 0.1])).as_rotvec()
    for sign in (1, -1):
        other = pose(turned, [1.03, 2, 3.04])
        other[:4] = [sign * number for number in other[:4]]
        assert prediction_error(start, other) == (pytest.approx(5.0), pytest.approx(degrees, abs=1e-6))


def test_prediction_error_of_nan_is_nan():
    assert all(math.isnan(number) for number in prediction_error(pose([0, 0, 0], [0, 0, 0]), [math.nan] * 7))


def test_min_eigenvalue_is_of_the_weakest_direction_per_pixel():
    turn = np.linalg.qr(np.random.default_rng(0).normal(size=(6, 6)))[0]
    hessian = turn @ np.diag([5.0, 7, 9, 20, 30, 40]) @ turn.T
    assert min_eigenvalue(hessian.ravel().tolist(), 10) == pytest.approx(0.5)
    assert min_eigenvalue([0.0] * 36, 10) == 0
    assert all(math.isnan(min_eigenvalue([bad] * 36, 10)) for bad in (math.nan, math.inf))


def test_min_eigenvalue_is_that_of_lapack():
    """To some fifty times the last bit of the largest eigenvalue, as far as LAPACK's own differs."""
    random = np.random.default_rng(1)
    for scale in 10.0 ** random.uniform(-8, 4, (200, 6)):
        turn = np.linalg.qr(random.normal(size=(6, 6)))[0]
        hessian = ((turn * scale) @ turn.T).astype(np.float32).astype(np.float64)
        hessian = np.triu(hessian) + np.triu(hessian, 1).T
        right = max(np.linalg.eigvalsh(hessian)[0], 0.0)
        assert min_eigenvalue(hessian.ravel().tolist(), 1) == pytest.approx(right, abs=1e-14 * scale.max())


def test_the_shipped_model_names_its_provenance():
    provenance = read_shipped(MODEL_FILE)["provenance"]
    assert set(provenance) == {"data", "command", "commits"}


@pytest.mark.parametrize("change", [{"intercept": None}, {"slope": 1.0}])
def test_a_model_of_other_constants_is_refused(monkeypatch, change):
    content = read_shipped(MODEL_FILE)
    constants = {name: value for name, value in {**content["constants"], **change}.items() if value is not None}
    monkeypatch.setattr(pose_confidence, "shipped_constants", lambda: constants)
    with pytest.raises(ConfigError, match="constants that do not match the program's: (intercept|slope); reinstall"):
        PoseConfidenceModel.load()
