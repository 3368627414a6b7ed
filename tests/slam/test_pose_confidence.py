"""The doubt about a pose: what raises it, what it is where nothing is known, and the measures it is made of."""

import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from spslam.slam.recovery.pose_confidence import Fit, min_eigenvalue, prediction_error

GOOD = Fit(0.5, 0.95, 0.8, 0.012, 0.5, 0.3, 0.02)


def pose(vector, translation):
    x, y, z, w = Rotation.from_rotvec(vector).as_quat()
    return [w, x, y, z, *translation]


def test_a_good_fit_leaves_no_doubt_and_a_bad_one_no_trust():
    assert GOOD.error_probability < 0.001
    assert Fit(1.2, 0.15, 0.06, 0.0005, 18.0, 5.0, 0.6).error_probability > 0.999


WORSE = {
    "mean_robust_weight": 0.4,
    "min_eigenvalue": 0.001,
    "prediction_error_cm": 20.0,
    "prediction_error_deg": 10.0,
    "free_space_violation": 0.2,
    "brightness_correlation": 0.1,
}


@pytest.mark.parametrize("measure", WORSE)
def test_each_measure_raises_the_doubt(measure):
    assert replace(GOOD, **{measure: WORSE[measure]}).error_probability > 2 * GOOD.error_probability


def test_support_is_held_against_what_the_map_covers():
    sparse = replace(GOOD, mean_robust_weight=0.3)
    assert replace(sparse, map_coverage=0.35).error_probability < 0.1 * sparse.error_probability
    assert replace(sparse, map_coverage=0.95).error_probability == sparse.error_probability
    assert replace(sparse, map_coverage=0.0).error_probability == sparse.error_probability
    # A wrong pose has no more on a map with holes.
    assert (
        replace(
            GOOD,
            mean_robust_weight=0.05,
            min_eigenvalue=0.0005,
            prediction_error_cm=18.0,
            free_space_violation=0.3,
            map_coverage=0.4,
        ).error_probability
        > 0.99
    )


def test_no_likeness_of_right_poses_makes_a_difference():
    for brightness_correlation in (0.26, 0.9, math.nan):
        assert replace(GOOD, brightness_correlation=brightness_correlation).error_probability == GOOD.error_probability
    # A plain thing before the lens that fits a wall.
    wall = Fit(1.0, 0.95, 0.8, 0.002, math.nan, math.nan, 0.002)
    assert wall.error_probability < 0.02
    assert replace(wall, brightness_correlation=0.0).error_probability > 0.5


def test_what_is_not_known_lies_between_right_and_wrong():
    for name, wrong in (("free_space_violation", 0.3), ("prediction_error_cm", 50.0)):
        unknown = replace(GOOD, **{name: math.nan}).error_probability
        assert GOOD.error_probability < unknown < replace(GOOD, **{name: wrong}).error_probability


def test_nothing_measured_is_no_number():
    assert math.isnan(Fit().error_probability)
    assert 0 < replace(GOOD, min_eigenvalue=0.0).error_probability < 1


def test_extremes_stay_probabilities():
    assert Fit(0, 0, 0, 0, 1e6, 180, 1).error_probability == pytest.approx(1)
    assert Fit(0, 1, 1, 1e3, 0, 0, 0).error_probability == pytest.approx(0, abs=1e-6)


@pytest.mark.parametrize("degrees", [0.0, 1e-4, 5.0, 179.0, 180.0])
def test_jump_is_distance_and_angle(degrees):
    axis = np.array([0.36, 0.48, 0.8])
    start = pose([0.3, -0.2, 0.1], [1, 2, 3])
    turned = (Rotation.from_rotvec(np.radians(degrees) * axis) * Rotation.from_rotvec([0.3, -0.2, 0.1])).as_rotvec()
    for sign in (1, -1):
        other = pose(turned, [1.03, 2, 3.04])
        other[:4] = [sign * number for number in other[:4]]
        assert prediction_error(start, other) == (pytest.approx(5.0), pytest.approx(degrees, abs=1e-6))


def test_jump_of_a_pose_of_nan_is_none():
    assert all(math.isnan(number) for number in prediction_error(pose([0, 0, 0], [0, 0, 0]), [math.nan] * 7))


def test_information_is_the_weakest_direction_a_pixel():
    turn = np.linalg.qr(np.random.default_rng(0).normal(size=(6, 6)))[0]
    hessian = turn @ np.diag([5.0, 7, 9, 20, 30, 40]) @ turn.T
    assert min_eigenvalue(hessian.flatten().tolist(), 10) == pytest.approx(0.5)
    assert min_eigenvalue([0.0] * 36, 10) == 0
    assert math.isnan(min_eigenvalue([math.nan] * 36, 10))
