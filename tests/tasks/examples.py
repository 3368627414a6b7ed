"""Tasks of `functions`, and an executor without processes."""

import contextlib

from spslam import ops
from spslam.tasks.child import execute
from spslam.tasks.task import Needs, Task, TaskCall, TaskEnd


def task(folder, key, function="write", **arguments):
    """A task without special needs."""
    return Task(key, f"tests.tasks.functions:{function}", {"text": key, **arguments}, folder / key, Needs())


class InThisProcess(contextlib.AbstractContextManager):
    """Runs tasks where the test runs; errors are raised."""

    slots = 1

    def start(self, task):
        task.output.mkdir(parents=True, exist_ok=True)
        execute(TaskCall(task.function, task.arguments, task.output, ops.get_num_threads(), 1))
        self.end = TaskEnd(task.key)

    def wait(self):
        return self.end

    def __exit__(self, *_):
        pass
