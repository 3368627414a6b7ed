"""Which fits say that a pose may have slid: along what surface leaves free, or half-way of a motion that surprised."""

from spslam.slam.fit import Fit
from spslam.slam.frame_history import FrameHistory

WEAK_EIGENVALUE = 0.004  # below it surface leaves a direction almost free: poses that slide fit, and are consistent
UNSURE_EIGENVALUE = 0.01  # below it so may a pose that was not predicted well
# Farther from the prediction, the brightness of earlier images, whose basin is a pixel or two, may not bring the pose
# back in a direction that surface leaves free.
UNSURE_CM, UNSURE_DEG = 0.5, 0.35
UNSURE_DEVIATION_M = 0.0035  # along the weakest direction, by how well surface fits: a noisy sensor says less of it
RARE_S = 0.11  # between frames farther apart a camera does so much that a pose as predicted is no sign of a right one
CONSISTENT_CM, CONSISTENT_DEG = 5.0, 4.0  # most prediction error from one frame to the next
# Between frames farther apart it is more: a camera that is carried has about such speeds, and accelerations.
CARRIED_CM_S, CARRIED_DEG_S = 150.0, 120.0
CARRIED_CM_S2, CARRIED_DEG_S2 = 1000.0, 800.0


def may_have_slid(fit: Fit, history: FrameHistory | None = None) -> bool:
    """Whether image features are to be asked: where surface leaves a direction free, and where the pose surprises.

    Args:
        fit: of the pose.
        history: the frames before, which say how long ago the last one was; None asks for what holds of a camera's
            usual 30 frames/s.
    """
    if fit.prediction_error_cm >= CONSISTENT_CM or fit.prediction_error_deg >= CONSISTENT_DEG:
        return True
    # A step longer than any that was seen does not say where the camera is if it leads elsewhere.
    if history is not None and history.steps > 1 and fit.is_far_from_prediction:
        return True
    is_rare = history is not None and history.interval_s > RARE_S
    if fit.prediction_error_cm > UNSURE_CM or fit.prediction_error_deg > UNSURE_DEG or is_rare:
        return fit.min_eigenvalue < UNSURE_EIGENVALUE or fit.deviation_m > UNSURE_DEVIATION_M
    return fit.min_eigenvalue < WEAK_EIGENVALUE


def is_consistent(fit: Fit, history: FrameHistory | None = None) -> bool:
    """Whether the pose is about where the frames before predict it; False where nothing does.

    Args:
        fit: of the pose.
        history: the frames before: the farther apart they are, and the less they say of a speed, the farther from the
            prediction it may be. None asks for what holds of a camera's usual 30 frames/s.
    """
    most_cm, most_deg = CONSISTENT_CM, CONSISTENT_DEG
    if history is not None:
        seconds = history.interval_s
        if history.knows_speed:
            carried = CARRIED_CM_S2 / 2 * seconds**2, CARRIED_DEG_S2 / 2 * seconds**2
        else:
            carried = CARRIED_CM_S * seconds, CARRIED_DEG_S * seconds
        most_cm, most_deg = max(most_cm, carried[0]), max(most_deg, carried[1])
    return fit.prediction_error_cm < most_cm and fit.prediction_error_deg < most_deg
