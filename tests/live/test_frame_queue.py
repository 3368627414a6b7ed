"""The queue keeps the newest frames, in order, and counts those that it drops."""

import threading
import time

import pytest

from spslam.errors import DatasetError
from spslam.live.frame_queue import FrameQueue
from spslam.live.latency import Latencies
from spslam.live.previews import PreviewStore
from spslam.live.source import LiveFrame
from tests.live.sources import plain_frame


class Clock:
    now = 0.0

    def __call__(self):
        return self.now


@pytest.fixture
def clock():
    return Clock()


def put(queue, *times):
    for time_s in times:
        queue.put(LiveFrame(plain_frame(round(30 * time_s)), time_s))


def taken(queue):
    return queue.take(0).complete_s


def test_frames_that_are_not_late_come_in_order(clock):
    queue = FrameQueue(0.06, clock=clock)
    put(queue, 0.0, 0.03, 0.06)
    clock.now = 0.06
    assert [taken(queue), taken(queue), taken(queue)] == [0.0, 0.03, 0.06]
    assert queue.take(0) is None
    assert queue.dropped == 0


def test_late_frames_are_dropped_but_never_the_newest(clock):
    queue = FrameQueue(0.06, clock=clock)
    put(queue, 0.0, 0.03, 0.06)
    clock.now = 0.1
    assert taken(queue) == 0.06
    assert queue.dropped == 2
    put(queue, 0.1)
    clock.now = 9.0
    assert taken(queue) == 0.1
    assert queue.dropped == 2


def test_a_full_queue_drops_the_oldest(clock):
    queue = FrameQueue(9.0, capacity=2, clock=clock)
    put(queue, 0.0, 0.1, 0.2)
    assert (taken(queue), taken(queue), queue.dropped) == (0.1, 0.2, 1)


def test_unusable_frames_are_passed_on():
    queue = FrameQueue(0.06)
    queue.put(DatasetError("broken"))
    put(queue, time.monotonic())
    assert str(queue.take(0)) == "broken"


def test_taking_waits_for_a_frame_and_ends_with_the_queue():
    queue = FrameQueue(0.06)
    threading.Timer(0.05, put, (queue, 1.0)).start()
    assert queue.take(5) is not None
    assert not queue.is_over
    threading.Timer(0.05, queue.close).start()
    began = time.monotonic()
    assert queue.take(5) is None
    assert time.monotonic() - began < 4
    assert queue.is_over


def test_latency_figures():
    latencies = Latencies()
    assert latencies.figures() == {}
    for ms in range(1, 102):
        latencies.add(ms)
    assert latencies.figures() == {"latency_p50_ms": 51, "latency_p99_ms": 100, "latency_max_ms": 101}
    assert latencies.last() == 101


@pytest.mark.parametrize(("length", "rows"), [(0, []), (2, [0, 1]), (5, [0, 2, 4]), (100, [0, 64, 96])])
def test_previews_are_spread_over_a_run_of_any_length(length, rows):
    store = PreviewStore(3)
    for row in range(length):
        store.add(row, plain_frame(row))
    assert [row for row, _ in store.frames()] == rows
    assert PreviewStore(0).frames() == []
