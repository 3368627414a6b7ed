"""Which frame is tracked again, and on what: a frame that predicted motion has bent."""

from dataclasses import replace
from types import SimpleNamespace

import pytest
import torch

from spslam import ops
from spslam.slam.constraints import Constraints
from spslam.slam.fit import Fit
from spslam.slam.localizer import Localizer
from spslam.slam.recovery.tracked_frame import TrackedFrame
from spslam.slam.tracker import PoseEstimate, TrackingProblem

STILL = torch.tensor([1.0, 0, 0, 0, 0, 0, 0])
FIRST, AGAIN, OTHER = (torch.tensor([1.0, 0, 0, 0, x, 0, 0]) for x in (0.1, 0.2, 0.3))
TURNED = torch.tensor([0.9998477, 0.0174524, 0, 0, 0.4, 0, 0])  # by two degrees


class Pixels:
    """Pixels of a frame, by what they were rectified."""

    def __init__(self, pose):
        self.records, self.pose = pose, pose


class Parts:
    """Tracker, recovery and rectifier that note what they are asked.

    Args:
        error_deg: from the prediction to what the tracker finds.
        answers: of the recovery, one per call.
    """

    def __init__(self, error_deg, *answers):
        self.error_deg, self.answers = error_deg, list(answers)
        self.tracked, self.resolved = [], []

    def track(self, problem, meanwhile=None):
        self.tracked.append(problem.records)
        return PoseEstimate(FIRST, 8, Fit(prediction_error_deg=self.error_deg), None)

    def track_again(self, problem, start):
        assert problem.records is problem.constraints.shutter.pose is start
        self.tracked.append(problem.records)
        return PoseEstimate(AGAIN, 4, Fit(prediction_error_deg=self.error_deg), None)

    def resolve(self, problem, estimate, pixels, history, to_be_mapped, features):
        assert pixels.records is problem.records
        self.resolved.append((estimate, features))
        answer = self.answers.pop(0)
        return TrackedFrame(estimate.pose, estimate.iterations, estimate.fit, 0.0, False) if answer is None else answer

    def frame(self, read, motion):
        assert read.pose is None
        return Pixels(motion.pose)

    def bends(self, motion, turn_deg):
        return turn_deg > 1


def localized(parts, has_shutter=True):
    shutter = ops.ShutterMotion(STILL, STILL, 1 / 30, torch.tensor([0.02])) if has_shutter else None
    problem = TrackingProblem(None, STILL, STILL, 1, Constraints(shutter=shutter))
    read = SimpleNamespace(pixels=Pixels(None))
    return Localizer(parts, parts, parts).localize(problem, Pixels(STILL), read, None, False)


@pytest.mark.parametrize(("error_deg", "has_shutter"), [(0.5, True), (2.0, False)])
def test_a_frame_that_was_predicted_well_or_at_once_is_tracked_once(error_deg, has_shutter):
    parts = Parts(error_deg, None)
    found = localized(parts, has_shutter)
    assert found.pose is FIRST and found.iterations == 8
    assert len(parts.tracked) == len(parts.resolved) == 1


def test_a_frame_that_turned_otherwise_is_rectified_by_what_was_found_and_decided_on_once():
    parts = Parts(2.0, None)
    found = localized(parts)
    assert parts.tracked[0] is STILL and parts.tracked[1] is FIRST
    assert found.pose is AGAIN and found.iterations == 12
    assert len(parts.resolved) == 1


RECOVERED = TrackedFrame(TURNED, 24, Fit(), 0.0, False, recovered=True, features=object())


def test_a_frame_recovered_elsewhere_is_tracked_and_decided_on_again():
    parts = Parts(0.5, RECOVERED, None)
    found = localized(parts)
    assert parts.tracked[1] is TURNED
    assert found.pose is AGAIN and found.iterations == 24 + 4
    assert found.recovered and found.features is RECOVERED.features
    assert parts.resolved[0][1] is parts.resolved[1][1]  # image features are extracted once


@pytest.mark.parametrize("near", [replace(RECOVERED, pose=OTHER), replace(RECOVERED, lost=True)])
def test_one_that_turned_as_it_was_rectified_or_is_lost_is_not(near):
    parts = Parts(0.5, near)
    assert localized(parts) is near


def test_what_was_known_is_kept_if_it_is_lost_then():
    parts = Parts(0.5, RECOVERED, replace(RECOVERED, lost=True))
    assert localized(parts) is RECOVERED
