"""The scheduler: starts tasks, starts again what died with its worker, and keeps a log."""

from __future__ import annotations

import json
from collections import Counter, deque
from collections.abc import Generator, Iterable
from dataclasses import asdict, replace
from pathlib import Path

from spslam.io import writing
from spslam.tasks.task import Executor, Task, TaskEnd

RETRIES = 2  # of a task whose worker died; what fails on its own account fails again
LOG = "tasks.jsonl"


def run_tasks(tasks: Iterable[Task], executor: Executor, log: Path) -> Generator[TaskEnd, None, None]:
    """Runs tasks and yields how each of them ended, in the order in which they end.

    Closing the generator starts nothing more; what is running ends with the executor's context.

    A task whose process or machine dies is started again, `RETRIES` times at most.

    Args:
        tasks: with different keys.
        executor: where they run.
        log: file that gets a line of JSON for each attempt that ends: the attributes of `TaskEnd`.

    Raises:
        OutputError: the log can't be written.
        SpslamError: the executor can't run anything any more.
    """
    waiting = deque(tasks)
    running: dict[str, Task] = {}
    attempts: Counter[str] = Counter()
    if waiting:
        executor.prepare(tuple(waiting))
    while waiting or running:
        while waiting and (executor.slots is None or len(running) < executor.slots):
            task = waiting.popleft()
            running[task.key] = task
            attempts[task.key] += 1
            executor.start(task)
        end = executor.wait()
        end = replace(end, attempt=attempts[end.key])
        with writing(log), log.open("a", encoding="utf-8") as file:
            file.write(json.dumps(asdict(end)) + "\n")
        task = running.pop(end.key)
        if end.lost and end.attempt <= RETRIES:
            waiting.appendleft(task)
        elif end.lost:
            yield replace(end, error=f"{end.error}, as in each of {end.attempt} attempts")
        else:
            yield end


def read_attempts(log: Path) -> list[TaskEnd]:
    """The lines of a log of `run_tasks`; none where there is no file."""
    if not log.is_file():
        return []
    lines = log.read_text(encoding="utf-8").splitlines(keepends=True)
    return [TaskEnd(**json.loads(line)) for line in lines if line.endswith("\n")]
