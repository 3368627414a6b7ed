"""A recording played back: its pace, its order, its faults."""

import time

import numpy as np
import pytest

from spslam.datasets.clock import CaptureOffsets
from spslam.errors import DatasetError
from spslam.live import replay
from spslam.live.replay import ReplaySource
from spslam.live.source import LiveFrame
from tests.system.sequences import Recorded


def frames_of(source):
    return [item for item in source.frames() if item is not None]


def test_frames_come_when_they_are_due():
    source, times = ReplaySource(Recorded(5), rate_hz=20), []
    for item in source.frames():
        times.append((item.complete_s, time.monotonic()))
    due, came = np.array(times).T
    np.testing.assert_allclose(np.diff(due), 0.05)
    assert (came >= due).all()
    assert source.dropped == 0


def test_the_recording_has_its_own_pace():
    dataset = Recorded(3)
    due = [item.complete_s for item in frames_of(ReplaySource(dataset))]
    np.testing.assert_allclose(np.diff(due), np.diff(dataset.timestamps()), atol=1e-6)


def test_repeated_it_goes_back_and_forth_in_time_that_ascends():
    dataset = Recorded(3)
    frames = [item.frame for item in frames_of(ReplaySource(dataset, 200, repeat=3))]
    assert [frame.index for frame in frames] == [0, 1, 2, 1, 0, 1, 2]
    np.testing.assert_allclose(np.diff([frame.timestamp for frame in frames]), 1 / 30, atol=1e-6)
    assert [frame.timestamp for frame in frames[:3]] == dataset.timestamps().tolist()


def test_on_the_way_back_color_that_was_later_is_earlier():
    def with_late_color(frame):
        frame.offsets = CaptureOffsets(0.002, 0.01)

    frames = [item.frame for item in frames_of(ReplaySource(Recorded(3, change=with_late_color), 200, repeat=3))]
    assert [frame.offsets.color for frame in frames] == [0.01, 0.01, 0.01, -0.01, -0.01, 0.01, 0.01]
    assert frames[3].offsets.depth == -0.002


def test_an_unreadable_frame_comes_as_its_error():
    def broken(frame):
        if frame.index == 1:
            raise DatasetError("frame 1 is broken")

    items = frames_of(ReplaySource(Recorded(3, broken), 200))
    assert [type(item) for item in items] == [LiveFrame, DatasetError, LiveFrame]


def test_where_decoding_is_too_slow_frames_are_left_out_and_counted(monkeypatch):
    monkeypatch.setattr(replay, "LATE_S", 0.02)
    source = ReplaySource(Recorded(20, lambda frame: time.sleep(0.03)), rate_hz=200, readers=1)
    items = frames_of(source)
    assert source.dropped > 5
    assert len(items) + source.dropped == 20


@pytest.mark.parametrize("options", [{"rate_hz": 0}, {"rate_hz": float("nan")}, {"repeat": 0}])
def test_wrong_arguments_are_refused(options):
    with pytest.raises(ValueError, match="must be"):
        ReplaySource(Recorded(2), **options)
