"""The clock of a run adds up the time of all its sessions."""

import json

import pytest

from spslam.run import clock as clock_module
from spslam.run.clock import RunClock


@pytest.fixture
def now(monkeypatch):
    """Seconds that `time.perf_counter` returns; a test sets them."""
    times = {"s": 100.0}
    monkeypatch.setattr(clock_module.time, "perf_counter", lambda: times["s"])
    return times


def test_resumed_run_continues_the_saved_clock(now):
    clock = RunClock()
    now["s"] = 105.0
    clock.start_s = 5.0
    clock.start_loop()
    for frames in (1, 2):
        now["s"] += 2.0
        clock.update(frames, decode_s=0.25 * frames)
    assert clock == RunClock(frames=2, wall_s=4.0, decode_s=0.5, start_s=5.0)

    saved = json.loads(json.dumps(clock.to_dict()))
    assert list(saved) == ["frames", "wall_s", "decode_s", "start_s"]
    now["s"] = 1000.0
    resumed = RunClock(**saved)
    resumed.start_s = 3.0
    resumed.start_loop()
    now["s"] += 10.0
    resumed.update(4, decode_s=1.0)
    assert resumed == RunClock(frames=6, wall_s=14.0, decode_s=1.5, start_s=3.0)


def test_time_that_the_user_took_is_left_out(now):
    clock = RunClock()
    clock.start_loop()
    now["s"] += 10.0
    clock.leave_out(7.0)
    clock.update(1, decode_s=0.0)
    assert clock.wall_s == 3.0
