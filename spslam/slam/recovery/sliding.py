"""Which fits say that a pose may have slid: along what surface leaves free, or half-way of a motion that surprised."""

from spslam.slam.fit import Fit

WEAK_EIGENVALUE = 0.004  # below it surface leaves a direction almost free: poses that slide fit, and are consistent
UNSURE_EIGENVALUE = 0.01  # below it so may a pose that was not predicted well
# Farther from the prediction, the brightness of earlier images, whose basin is a pixel or two, may not bring the pose
# back in a direction that surface leaves free.
UNSURE_CM, UNSURE_DEG = 0.5, 0.35
UNSURE_DEVIATION_M = 0.0035  # along the weakest direction, by how well surface fits: a noisy sensor says less of it
CONSISTENT_CM, CONSISTENT_DEG = 5.0, 4.0  # most prediction error from one frame to the next
# The acceleration of a camera that is carried: at fewer than ten frames/s it leaves the prediction by more than that.
CARRIED_M_S2, CARRIED_DEG_S2 = 10.0, 800.0


def may_have_slid(fit: Fit) -> bool:
    """Whether image features are to be asked: where surface leaves a direction free, and where the pose surprises."""
    if fit.prediction_error_cm >= CONSISTENT_CM or fit.prediction_error_deg >= CONSISTENT_DEG:
        return True
    if fit.prediction_error_cm > UNSURE_CM or fit.prediction_error_deg > UNSURE_DEG:
        return fit.min_eigenvalue < UNSURE_EIGENVALUE or fit.deviation_m > UNSURE_DEVIATION_M
    return fit.min_eigenvalue < WEAK_EIGENVALUE


def is_consistent(fit: Fit, interval_s: float = 0.0) -> bool:
    """Whether the pose is about where the frames before predict it; False where nothing does.

    Args:
        fit: of the pose.
        interval_s: from one frame to the next, s; 0 where that is not known.
    """
    most_cm = max(CONSISTENT_CM, 50 * CARRIED_M_S2 * interval_s**2)
    most_deg = max(CONSISTENT_DEG, CARRIED_DEG_S2 / 2 * interval_s**2)
    return fit.prediction_error_cm < most_cm and fit.prediction_error_deg < most_deg
