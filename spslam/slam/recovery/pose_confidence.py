"""Whether a pose is to be trusted: the odds that it is wrong, from all that its fit to the map says.

A logistic model of five measures, fitted to right poses of clean runs and to what tracking makes of wrong starts
(docs/tracking-failure.md has the figures and the command):

    ln odds = -7.3 - 10 support - 2.1 lg(information) + 3.6 jump + 23 conflict + 20 max(0.25 - likeness, 0)

support is the mean robust weight of the frame's pixels by a kernel of 2 cm, whatever width tracking ends with;
information the smallest eigenvalue of the normal equations a pixel, scaled as if by those weights (how well the worst
direction is held; m and rad about the camera), jump = ln(1 + distance / 5 cm + angle / 2.5 degrees) from where the
motion model put the camera, conflict the share of the surface known from other frames that it would have to look
through. Support counts for more on a map with holes, as small images or few points leave it, and information below
0.002, the least of clean runs, two and a half times as much. likeness is the correlation of the picture's brightness
with that of the map's colors; right poses have 0.26 or more, and only less counts.
What is not known takes part as a number between right and wrong.
"""

import math
from dataclasses import dataclass

import numpy as np

CONSTANT, PER_SUPPORT, PER_INFORMATION, PER_JUMP, PER_CONFLICT = -7.3, -10.0, -2.1, 3.6, 23.0
PER_UNLIKENESS, LEAST_LIKENESS = 20.0, 0.25  # or more, of right poses
SCORE_KERNEL_M = 0.02  # of the weights behind support and information
JUMP_CM, JUMP_DEG = 5.0, 2.5
LEAST_INFORMATION = 1e-6
FIRM_INFORMATION = 0.002  # or more, in clean runs; with less, a pose slides where little holds it
PER_WEAK_INFORMATION = 2.5  # as much as above that
MOST_CONFLICT = 0.3  # beyond it one wrong pose is as wrong as another
UNKNOWN_JUMP, UNKNOWN_CONFLICT = 1.3, 0.11
USUAL_COVERAGE = 0.9  # or more, in the runs of the calibration
MOST_HIDDEN = 0.15  # of known surface; in clean runs it is at most 0.07


@dataclass(frozen=True)
class Fit:
    """How a pose fits; NaN where something was not measured.

    Attributes:
        residual_cm: root mean squared distance of the pixels to the mapped surface, weighted as in `mean_robust_weight`.
        inlier_share: share of the pixels that fall on mapped surface.
        mean_robust_weight: mean robust weight (`SCORE_KERNEL_M`) of all pixels, from 0 (none fits the map) to 1 (all do).
        min_eigenvalue: smallest eigenvalue of the normal equations a pixel, 1.
        prediction_error_cm, prediction_error_deg: distance and angle to the pose that was expected.
        free_space_violation: share of the surface in view, as other frames know it, that the frame looks through.
        occluded_share: share of it that something nearer hides from the frame; no sign of a wrong pose.
        map_coverage: share of the last trusted frame's pixels on mapped surface. Where images are small or points are few
            the map has holes, and no pose has more support than this.
        brightness_correlation: correlation of the brightness of its pixels with the map's colors.
    """

    residual_cm: float = math.nan
    inlier_share: float = math.nan
    mean_robust_weight: float = math.nan
    min_eigenvalue: float = math.nan
    prediction_error_cm: float = math.nan
    prediction_error_deg: float = math.nan
    free_space_violation: float = math.nan
    occluded_share: float = math.nan
    map_coverage: float = math.nan
    brightness_correlation: float = math.nan

    @property
    def is_obstructed(self) -> bool:
        """Whether something is before the lens that is no part of the scene."""
        return self.occluded_share > MOST_HIDDEN

    @property
    def error_probability(self) -> float:
        """Probability in [0, 1] that the pose is wrong; NaN where nothing was measured."""
        if math.isnan(self.mean_robust_weight) or math.isnan(self.min_eigenvalue):
            return math.nan
        prediction_error = math.log1p(self.prediction_error_cm / JUMP_CM + self.prediction_error_deg / JUMP_DEG)
        odds = (
            CONSTANT
            + PER_SUPPORT * self._support_of_covered
            + PER_INFORMATION * self._lg_information
            + PER_JUMP * (UNKNOWN_JUMP if math.isnan(prediction_error) else prediction_error)
            + PER_CONFLICT
            * (
                UNKNOWN_CONFLICT
                if math.isnan(self.free_space_violation)
                else min(self.free_space_violation, MOST_CONFLICT)
            )
            + PER_UNLIKENESS * self._unlikeness
        )
        return 1 / (1 + math.exp(-odds))

    @property
    def _lg_information(self) -> float:
        """The logarithm of the information, which falls two and a half times as fast below that of any clean run."""
        lg = math.log10(max(self.min_eigenvalue, LEAST_INFORMATION))
        return lg + (PER_WEAK_INFORMATION - 1) * min(lg - math.log10(FIRM_INFORMATION), 0.0)

    @property
    def _unlikeness(self) -> float:
        """What is missing of the least likeness of right poses."""
        return (
            0.0 if math.isnan(self.brightness_correlation) else max(LEAST_LIKENESS - self.brightness_correlation, 0.0)
        )

    @property
    def _support_of_covered(self) -> float:
        """The support, as it would be on a map with as few holes as those of the calibration."""
        if not 0 < self.map_coverage < USUAL_COVERAGE:
            return self.mean_robust_weight
        return min(self.mean_robust_weight * USUAL_COVERAGE / self.map_coverage, 1.0)


def prediction_error(start: list[float], pose: list[float]) -> tuple[float, float]:
    """Distance (cm) and angle (degrees) between two poses, each seven numbers; NaN where one of them is."""
    near, far = (math.dist(start[:4], [sign * number for number in pose[:4]]) for sign in (1, -1))
    chord = min(near, far, 2.0) if near == near else math.nan  # 2 sin(angle / 4), exact for small angles too
    return 100 * math.dist(start[4:], pose[4:]), math.degrees(4 * math.asin(chord / 2))


def min_eigenvalue(hessian: list[float], pixels: int) -> float:
    """Smallest eigenvalue of the normal equations a pixel; NaN where they hold no number.

    Args:
        hessian: 36 numbers, symmetric.
        pixels: that they are a sum over.
    """
    matrix = np.array(hessian).reshape(6, 6)
    if not np.isfinite(matrix).all():
        return math.nan
    return max(float(np.linalg.eigvalsh(matrix)[0]), 0.0) / pixels
