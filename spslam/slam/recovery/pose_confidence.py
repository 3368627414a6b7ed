"""The probability that a pose is wrong, from all measures of its fit.

A logistic model, fitted to correct poses and to wrong ones to which tracking converged from wrong initial poses:

    ln odds = intercept + sum of factor * measure

over the mean robust weight, log10(min_eigenvalue), ln(1 + prediction error), the free-space violation and the
shortfalls of the brightness correlation and of the share of agreeing image features below the minima of correct poses.
docs/tracking-failure.md explains the terms and how well they separate correct from wrong poses; the constants and their
origin are in configs/models/pose_confidence.yaml.
"""

import functools
import math
from collections.abc import Mapping
from dataclasses import dataclass, fields
from types import MappingProxyType

from spslam.config import read_shipped
from spslam.errors import ConfigError
from spslam.slam.fit import Fit

MODEL_FILE = "models/pose_confidence.yaml"


@functools.cache
def shipped_constants() -> Mapping[str, float]:
    """The shipped model's constants as its file has them, by name; it is read once."""
    return MappingProxyType(read_shipped(MODEL_FILE)["constants"])


@dataclass(frozen=True)
class PoseConfidenceModel:
    """Fitted constants; see the comments in configs/models/pose_confidence.yaml.

    Attributes:
        intercept: ln odds of an error where all measures are 0.
        per_mean_robust_weight, per_log10_min_eigenvalue, per_prediction_error, per_free_space_violation,
            per_missing_correlation, per_missing_feature_share: factors of the measures.
        score_kernel_m: width of the robust kernel that the first two are measured by, m.
        prediction_error_scale_cm, prediction_error_scale_deg: what counts as 1 in ln(1 + distance + angle).
        eigenvalue_floor, firm_eigenvalue, weak_eigenvalue_factor: how small eigenvalues count.
        max_free_space_violation: larger ones count as this.
        unknown_prediction_error, unknown_free_space_violation: used where the measure is NaN.
        expected_map_coverage: map coverage below which the mean robust weight is scaled up.
        min_brightness_correlation, min_feature_share: minima of correct poses.
        min_relocalized_correlation: of brightness, least of a pose where the camera may be anywhere.
        max_occluded_share: above it the frame is occluded.
        min_feature_inliers: with as many the pose is known without the motion model.
        min_holding_inliers, min_holding_share: with as many the pose is held where surface leaves it free.
        max_followed_cm, max_followed_deg: a camera farther from the prediction has jumped, and may be anywhere.
    """

    intercept: float
    per_mean_robust_weight: float
    per_log10_min_eigenvalue: float
    per_prediction_error: float
    per_free_space_violation: float
    per_missing_correlation: float
    score_kernel_m: float
    prediction_error_scale_cm: float
    prediction_error_scale_deg: float
    eigenvalue_floor: float
    firm_eigenvalue: float
    weak_eigenvalue_factor: float
    max_free_space_violation: float
    unknown_prediction_error: float
    unknown_free_space_violation: float
    expected_map_coverage: float
    min_brightness_correlation: float
    min_relocalized_correlation: float
    max_occluded_share: float
    min_feature_inliers: float
    per_missing_feature_share: float
    min_feature_share: float
    min_holding_inliers: float
    min_holding_share: float
    max_followed_cm: float
    max_followed_deg: float

    @classmethod
    def load(cls) -> "PoseConfidenceModel":
        """The shipped model.

        Raises:
            ConfigError: the shipped file lacks a constant, or holds one that is none of the model's.
        """
        constants = shipped_constants()
        names = {field.name for field in fields(cls)}
        if set(constants) != names:
            different = ", ".join(sorted(set(constants) ^ names))
            raise ConfigError(f"{MODEL_FILE}: constants that do not match the program's: {different}; reinstall spslam")
        return cls(**{name: float(value) for name, value in constants.items()})

    def error_probability(self, fit: Fit, compares: bool = False) -> float:
        """Probability in [0, 1] that the pose is wrong; NaN where it was not tracked.

        Args:
            fit: of the pose.
            compares: with other poses of the frame: then the motion model counts even where image features hold it, as
                they may hold several.
        """
        if math.isnan(fit.mean_robust_weight) or math.isnan(fit.min_eigenvalue):
            return math.nan
        violation = fit.free_space_violation
        violation = self.unknown_free_space_violation if math.isnan(violation) else violation
        ln_odds = (
            self.intercept
            + self.per_mean_robust_weight * self._weight_where_mapped(fit)
            + self.per_log10_min_eigenvalue * self._log10_min_eigenvalue(fit)
            + self.per_prediction_error * self._prediction_error(fit, compares)
            + self.per_free_space_violation * min(violation, self.max_free_space_violation)
            + self.per_missing_correlation * self._missing_correlation(fit)
            + self.per_missing_feature_share * self._missing_feature_share(fit)
        )
        return 1 / (1 + math.exp(-ln_odds))

    def is_occluded(self, fit: Fit) -> bool:
        """Whether something that is not part of the scene is in front of the camera; False if it was not measured."""
        return fit.occluded_share > self.max_occluded_share

    def is_confirmed(self, fit: Fit) -> bool:
        """Whether enough image features agree with the pose, and most of those that agree with one another."""
        return fit.feature_inliers >= self.min_feature_inliers and fit.feature_share >= self.min_feature_share

    def is_held(self, fit: Fit) -> bool:
        """Whether image features hold the pose; where the camera may be anywhere, places alike have them alike."""
        is_predicted = not math.isnan(fit.prediction_error_cm) and not self.has_jumped(fit)
        return is_predicted and self.has_many_features(fit)

    def has_jumped(self, fit: Fit) -> bool:
        """Whether the pose is too far from the prediction to be followed; False where nothing is predicted."""
        return fit.prediction_error_cm > self.max_followed_cm or fit.prediction_error_deg > self.max_followed_deg

    def looks_elsewhere(self, fit: Fit) -> bool:
        """Whether earlier images show too different a brightness there: in places that are alike surface fits, frame by
        frame. False where nothing was compared."""
        return fit.brightness_correlation < self.min_relocalized_correlation

    def has_many_features(self, fit: Fit) -> bool:
        """Whether as many image features agree with the pose as hold one.

        Those beyond the range of depth count as well: they tell how the camera has turned, if not how far it has gone.
        """
        rays = 0.0 if math.isnan(fit.feature_rays) else fit.feature_rays
        are_enough = fit.feature_inliers >= self.min_feature_inliers
        are_enough = are_enough and fit.feature_inliers + rays >= self.min_holding_inliers
        return are_enough and fit.feature_share >= self.min_holding_share

    def _weight_where_mapped(self, fit: Fit) -> float:
        """The mean robust weight, as it would be on a map with as few holes as those of the calibration.

        Where image features confirm the pose, pixels off the map are of what was not seen yet, and do not count.
        """
        if self.is_confirmed(fit) and fit.inlier_share > 0:
            return min(fit.mean_robust_weight / fit.inlier_share, 1.0)
        if not 0 < fit.map_coverage < self.expected_map_coverage:
            return fit.mean_robust_weight
        return min(fit.mean_robust_weight * self.expected_map_coverage / fit.map_coverage, 1.0)

    def _log10_min_eigenvalue(self, fit: Fit) -> float:
        """log10 of the smallest eigenvalue, falling faster below `firm_eigenvalue` unless features hold the pose."""
        least = self.firm_eigenvalue if self.is_held(fit) else self.eigenvalue_floor
        lg = math.log10(max(fit.min_eigenvalue, least))
        return lg + (self.weak_eigenvalue_factor - 1) * min(lg - math.log10(self.firm_eigenvalue), 0.0)

    def _prediction_error(self, fit: Fit, compares: bool) -> float:
        error = math.log1p(
            fit.prediction_error_cm / self.prediction_error_scale_cm
            + fit.prediction_error_deg / self.prediction_error_scale_deg
        )
        if math.isnan(error):
            return self.unknown_prediction_error
        if self.is_held(fit) and fit.inlier_share > 0 and not compares:
            return 0.0
        # Features that agree with the pose say nothing of the motion model, which may then be wrong.
        is_confirmed = fit.feature_inliers >= self.min_feature_inliers
        return min(error, self.unknown_prediction_error) if is_confirmed else error

    def _missing_correlation(self, fit: Fit) -> float:
        # Images that are blurred while the camera turns correlate less; features that hold the pose tell more.
        if math.isnan(fit.brightness_correlation) or self.is_held(fit):
            return 0.0
        return max(self.min_brightness_correlation - fit.brightness_correlation, 0.0)

    def _missing_feature_share(self, fit: Fit) -> float:
        share = fit.feature_share
        return 0.0 if math.isnan(share) else max(self.min_feature_share - share, 0.0)
