"""The viewer's process gives way to the run: priorities of its threads, and a budget of processor time."""

import os
import subprocess
import sys
import threading
import time

import pytest

from spslam.viewer import priority
from spslam.viewer.priority import Budget
from spslam.viewer.worker import NewestWorker

SHARE = 0.25


@pytest.fixture
def clocks(monkeypatch):
    """Clocks that stand still until a test, or a wait, moves them."""

    class Clocks:
        wall_s = spent_s = 0.0

        def wait(self, seconds):
            self.wall_s += seconds
            return False

    made = Clocks()
    monkeypatch.setattr(priority.time, "perf_counter", lambda: made.wall_s)
    monkeypatch.setattr(priority.time, "process_time", lambda: made.spent_s)
    return made


def test_work_is_paid_off_at_the_share(clocks):
    budget = Budget(SHARE)
    clocks.spent_s = 2.0
    budget.wait(0.0, clocks, least_s=1.0)
    assert clocks.wall_s == pytest.approx(2.0 / SHARE)


def test_work_that_takes_little_goes_on_while_a_debt_is_paid_off(clocks):
    budget = Budget(SHARE)
    clocks.spent_s = 2.0
    budget.wait(1.5, clocks, least_s=0.1)
    assert clocks.wall_s == pytest.approx(0.5 / SHARE)


def test_unspent_time_is_not_saved_up(clocks):
    budget = Budget(SHARE)
    budget.wait(0.0, clocks, least_s=1000.0)
    clocks.spent_s = 2.0
    budget.wait(0.0, clocks, least_s=1.0)
    assert clocks.wall_s == pytest.approx(1000.0 + 2.0 / SHARE)


def test_rest_has_an_end(clocks):
    budget = Budget(SHARE)
    clocks.spent_s = 1e6
    budget.wait(0.0, clocks, most_s=3.0)
    assert clocks.wall_s == pytest.approx(3.0)
    ends = threading.Event()
    ends.set()
    began = time.monotonic()
    budget.wait(0.0, ends, least_s=30.0)
    assert time.monotonic() - began < 10


@pytest.mark.skipif(not hasattr(os, "SCHED_IDLE"), reason="the system has no such scheduling")
def test_heavy_work_is_done_in_spare_time():
    policies = []
    worker = NewestWorker(lambda _: policies.append(os.sched_getscheduler(0)), "test", spare_time_only=True)
    worker.submit(1)
    assert worker.wait_until_idle(30)
    worker.close()
    assert policies == [os.SCHED_IDLE]
    assert os.sched_getscheduler(0) != os.SCHED_IDLE


def test_threads_that_run_already_give_way_too():
    """In a process of its own, as a priority can't always be raised again."""
    code = (
        "import os, threading\n"
        "from spslam.viewer.priority import give_way\n"
        "release = threading.Event()\n"
        "thread = threading.Thread(target=release.wait)\n"
        "thread.start()\n"
        "before = os.getpriority(os.PRIO_PROCESS, 0)\n"
        "give_way()\n"
        "print(before, os.getpriority(os.PRIO_PROCESS, 0), os.getpriority(os.PRIO_PROCESS, thread.native_id))\n"
        "release.set()\n"
    )
    shown = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    before, main, other = map(int, shown.split())
    assert main == other >= before
    assert main > 0
