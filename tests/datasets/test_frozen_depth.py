"""Frozen depth: found where color moves on, not where the camera stands or the exposure changes."""

import numpy as np
import pytest

from spslam.datasets.base import RgbdFrame
from spslam.datasets.frozen_depth import ArrivingFrozenDepth, FrameSignature, FrozenDepth, frozen_depth_before
from spslam.datasets.generated import GeneratedDataset
from spslam.errors import DatasetError

NOISE = np.random.default_rng(0)


@pytest.fixture(scope="module")
def frames():
    dataset = GeneratedDataset(6, 160, 120)
    return [dataset[i] for i in range(6)]


def with_depth_of(frame, other):
    return RgbdFrame(frame.index, frame.timestamp, frame.color, other.depth.copy(), frame.pose)


def checks(frames):
    """By signatures that are kept, and by those of a camera that has all its images in the same memory."""
    frozen, arriving, answers = FrozenDepth(), ArrivingFrozenDepth(), []
    color, depth = np.empty_like(frames[0].color), np.empty_like(frames[0].depth)
    for frame in frames:
        color[:], depth[:] = frame.color, frame.depth
        answers.append(frozen.check(FrameSignature.of(frame)))
        arrived = RgbdFrame(frame.index, frame.timestamp, color, depth)
        assert arriving.check(arrived) is answers[-1]
        if not answers[-1]:
            arriving.keep(arrived)
    return answers


def test_a_moving_camera(frames):
    assert checks(frames) == [False] * 6


def test_frozen_depth_until_it_goes_on(frames):
    recorded = [frames[0], frames[1], *(with_depth_of(frame, frames[1]) for frame in frames[2:5]), frames[5]]
    assert checks(recorded) == [False, False, True, True, True, False]


def test_a_camera_that_stands_still_with_noise_and_another_exposure(frames):
    still = []
    for gain, offset in ((1.0, 0), (1.0, 0), (0.8, 0), (1.1, 0), (1.0, 8)):
        color = gain * frames[0].color + offset + NOISE.normal(0, 3, frames[0].color.shape)
        still.append(RgbdFrame(0, 0.0, np.clip(color, 0, 255).astype(np.uint8), frames[0].depth.copy()))
    assert checks(still) == [False] * 5


def test_frames_without_depth_are_not_frozen(frames):
    empty = [RgbdFrame(i, 0.0, frame.color, np.zeros_like(frame.depth)) for i, frame in enumerate(frames)]
    assert checks(empty) == [False] * 6


def test_depth_that_is_not_a_number_may_be_frozen_too(frames):
    holed = [with_depth_of(frame, frames[0]) for frame in frames[:3]]
    for frame in holed:
        frame.depth[::3] = np.nan
    assert checks(holed) == [False, True, True]


@pytest.mark.parametrize("start", range(7))
def test_going_on_anywhere_gives_the_same(frames, start):
    class Recorded(list):
        def __getitem__(self, index):
            if index == 3:
                raise DatasetError("frame 3 is broken")
            return super().__getitem__(index)

    recorded = Recorded([frames[0], frames[1], *(with_depth_of(frame, frames[1]) for frame in frames[2:5]), frames[5]])
    readable = [i for i in range(6) if i != 3]
    whole = dict(zip(readable, checks([list.__getitem__(recorded, i) for i in readable]), strict=True))
    frozen = frozen_depth_before(recorded, start)
    rest = {i: frozen.check(FrameSignature.of(recorded[i])) for i in readable if i >= start}
    assert rest == {i: whole[i] for i in rest}
