"""How the viewer's process gives way to the run, on whose processors it works."""

from __future__ import annotations

import contextlib
import os
import threading
import time
from pathlib import Path

_NICENESS = 17  # by the scheduler's weights, 2 % of a core that the run wants as well


def give_way() -> None:
    """A low priority for this process's threads and those that they start: the page still answers."""
    # Under Linux each thread has a priority of its own.
    tasks = Path("/proc/self/task")
    for thread in [int(task.name) for task in tasks.iterdir()] if tasks.is_dir() else [0]:
        with contextlib.suppress(OSError):
            os.setpriority(os.PRIO_PROCESS, thread, _NICENESS)


def take_spare_time_only() -> None:
    """Lets this thread work where a core has nothing else to do; does nothing where the system can't.

    A niceness does not suffice for work that takes long: of it, the scheduler first lets a slice of milliseconds end
    before a thread of the run that wakes up may go on, and others of its threads wait for that one. A kernel of the
    run takes less than a slice.
    """
    if hasattr(os, "SCHED_IDLE"):
        with contextlib.suppress(OSError):
            os.sched_setscheduler(0, os.SCHED_IDLE, os.sched_param(0))


class Budget:
    """Holds the processor time of this process, of all its threads, to a share of one core.

    Work is not cut short. What took t seconds is a debt that is paid off after t / share seconds, and work waits until
    the debt is small enough; unspent time is not saved up.

    Args:
        share: of one core.
    """

    def __init__(self, share: float):
        self._share, self._lock = share, threading.Lock()
        self._debt_s = 0.0
        self._seen = time.perf_counter(), time.process_time()

    def wait(self, allowed_debt_s: float, ends: threading.Event, least_s: float = 0.0, most_s: float = 60.0) -> None:
        """Waits until the debt is at most `allowed_debt_s`, from `least_s` to `most_s` seconds, or until `ends`."""
        deadline_s = time.perf_counter() + most_s
        pause_s = least_s
        while not ends.wait(pause_s):
            pause_s = min((self._debt() - allowed_debt_s) / self._share, deadline_s - time.perf_counter())
            if pause_s <= 0:
                return

    def _debt(self) -> float:
        with self._lock:
            before, self._seen = self._seen, (time.perf_counter(), time.process_time())
            wall_s, spent_s = (now - then for now, then in zip(self._seen, before, strict=True))
            self._debt_s = max(self._debt_s + spent_s - self._share * wall_s, 0.0)
            return self._debt_s
