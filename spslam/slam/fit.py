"""How well a pose fits what is known: the measures that tracking and verification take of it."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from struct import Struct

from spslam.image_library import image_library

FAR_CM, FAR_DEG = 2.0, 1.5  # from the prediction
INDEPENDENT_PIXELS = 300  # as many a frame's pixels are worth: the map's errors are alike for neighbors
LEAST_DEVIATION_M = 0.003  # of a pixel
_MATRIX = Struct("36d")


@dataclass(frozen=True)
class Fit:
    """Measures of one pose; NaN where something was not measured.

    Attributes:
        residual_cm: RMS distance of the frame's pixels to the mapped surface, weighted as in `mean_robust_weight`.
        inlier_share: share of the pixels that fall on mapped surface.
        mean_robust_weight: mean robust weight of all pixels by the score kernel, from 0 (none fits the map) to 1.
        min_eigenvalue: smallest eigenvalue of the normal matrix divided by the number of pixels (m and rad): how well
            the least constrained direction is determined.
        prediction_error_cm, prediction_error_deg: distance and angle to the pose that the motion model predicted.
        free_space_violation: share of the surface known from other frames that the frame would look through.
        occluded_share: share of that surface that something nearer occludes; no sign of a wrong pose.
        map_coverage: share of the last trusted frame's pixels that fall on mapped surface. Where images are small or
            points are few the map has holes, and no pose has a larger mean robust weight than this.
        brightness_correlation: correlation of the brightness of earlier frames' points with that of the frame, where
            it sees them.
        feature_inliers: number of image features whose points in earlier frames lie, from the pose, within 0.33
            degrees of where the frame shows them.
        feature_share: of the features that agree on a pose, the share that agrees with this one; of the earlier frames
            that they were matched with, the least, or where surface holds the pose in all directions that of the frame
            with which most agree. Unknown where colors are not where depth is.
        feature_rays: number of image features that were beyond the range of the last frame's depth and lie, from the
            pose, within that angle of where they may be on their rays.
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
    feature_inliers: float = math.nan
    feature_share: float = math.nan
    feature_rays: float = math.nan

    def having(self, **measures: float) -> "Fit":
        """The same, but for measures by their names; what `dataclasses.replace` makes, in a third of the time."""
        other = object.__new__(type(self))
        other.__dict__.update(self.__dict__, **measures)
        return other

    def unpredicted(self) -> "Fit":
        """The same of a camera that may be anywhere: nothing says how far it is from where it was expected."""
        return self.having(prediction_error_cm=math.nan, prediction_error_deg=math.nan)

    @property
    def is_far_from_prediction(self) -> bool:
        """Whether the motion model was wrong by so much that tracking may have stopped half-way, or slid."""
        return self.prediction_error_cm > FAR_CM or self.prediction_error_deg > FAR_DEG

    @property
    def deviation_m(self) -> float:
        """Standard deviation of the pose along the direction that surface determines least, m or rad; infinite where
        surface determines none."""
        if not self.min_eigenvalue > 0:
            return math.inf
        return math.sqrt(pose_variance((self.residual_cm / 100) ** 2) / self.min_eigenvalue)


def pose_variance(mean_square: float) -> float:
    """Variance of a pose along a direction of eigenvalue 1 per pixel, by the pixels' mean square residual, both m^2."""
    return max(mean_square, LEAST_DEVIATION_M**2) / INDEPENDENT_PIXELS


def prediction_error(predicted: Sequence[float], pose: Sequence[float]) -> tuple[float, float]:
    """Distance (cm) and angle (degrees) between two poses of seven numbers each; NaN where one of them is.

    As csrc/kernels/frame_outcome.h has it on a device, where a frame that is followed is decided on.
    """
    turn = pose[:4]
    near, far = math.dist(predicted[:4], turn), math.dist(predicted[:4], [-number for number in turn])
    chord = min(near, far, 2.0) if near == near else math.nan  # 2 sin(angle / 4), exact for small angles too
    return 100 * math.dist(predicted[4:], pose[4:]), math.degrees(4 * math.asin(chord / 2))


def min_eigenvalue(hessian: Sequence[float], pixels: int) -> float:
    """Smallest eigenvalue of the normal equations per pixel; NaN where the matrix is not finite.

    Args:
        hessian: 36 numbers, a symmetric matrix by rows.
        pixels: how many pixels it is a sum over.
    """
    least = image_library().spslam_least_eigenvalue(_MATRIX.pack(*hessian))
    return least / pixels if not least < 0 else 0.0
