"""Tasks of `functions`, and an executor without processes."""

import contextlib
import time

import pytest

from spslam import ops
from spslam.tasks.child import execute
from spslam.tasks.task import Needs, Task, TaskCall, TaskEnd


def task(folder, key, function="write", memory_mb=0, **arguments):
    """A task without other needs than memory."""
    return Task(
        key, f"tests.tasks.functions:{function}", {"text": key, **arguments}, folder / key, Needs(memory_mb=memory_mb)
    )


def wait_for(condition, what, most_s=120):
    """Returns when a condition holds; fails with `what` did not happen where it does not in time."""
    started = time.monotonic()
    while not condition():
        if time.monotonic() - started > most_s:
            pytest.fail(f"{what} did not happen within {most_s} s")
        time.sleep(0.05)


class InThisProcess(contextlib.AbstractContextManager):
    """Runs tasks where the test runs; errors are raised."""

    slots = 1

    def prepare(self, tasks):
        pass

    def start(self, task):
        task.output.mkdir(parents=True, exist_ok=True)
        execute(TaskCall(task.function, task.arguments, task.output, ops.get_num_threads(), 1))
        self.end = TaskEnd(task.key)

    def wait(self):
        return self.end

    def __exit__(self, *_):
        pass
