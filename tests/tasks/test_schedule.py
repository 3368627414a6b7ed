"""The scheduler, with an executor that ends tasks as it is told."""

import contextlib
import json

from spslam.tasks.schedule import RETRIES, read_attempts, run_tasks
from spslam.tasks.task import TaskEnd
from tests.tasks.examples import task


class Scripted(contextlib.AbstractContextManager):
    """Ends each attempt at a task by the next of its errors; `!` before one says that the worker died."""

    def __init__(self, slots=None, **errors):
        self.slots, self.errors, self.started, self.most = slots, errors, [], 0

    def prepare(self, tasks):
        self.prepared = [task.key for task in tasks]

    def start(self, task):
        self.started.append(task.key)
        self.most = max(self.most, len(self.started))

    def wait(self):
        key = self.started.pop(0)
        error = self.errors[key].pop(0) if self.errors.get(key) else ""
        return TaskEnd(key, error.removeprefix("!"), error.startswith("!"), "node", 1.0)

    def __exit__(self, *_):
        pass


def run(tmp_path, executor, *keys):
    return {end.key: end for end in run_tasks([task(tmp_path, key) for key in keys], executor, tmp_path / "log")}


def test_a_dead_worker_costs_one_retry(tmp_path):
    ends = run(tmp_path, Scripted(b=["!its worker died"]), "a", "b")
    assert [(end.error, end.attempt) for end in ends.values()] == [("", 1), ("", 2)]
    attempts = read_attempts(tmp_path / "log")
    assert [(each.key, each.lost, each.attempt) for each in attempts] == [
        ("a", False, 1),
        ("b", True, 1),
        ("b", False, 2),
    ]


def test_what_always_dies_is_given_up(tmp_path):
    ends = run(tmp_path, Scripted(a=["!ended by signal 9"] * 9), "a", "b")
    assert ends["a"].error == f"ended by signal 9, as in each of {RETRIES + 1} attempts"
    assert not ends["b"].error


def test_what_fails_is_not_tried_again(tmp_path):
    assert run(tmp_path, Scripted(a=["no such file"]), "a")["a"].error == "no such file"
    assert len(read_attempts(tmp_path / "log")) == 1


def test_no_more_than_the_slots_are_started(tmp_path):
    limited, unlimited = Scripted(2), Scripted()
    run(tmp_path, limited, *"abcde")
    run(tmp_path, unlimited, *"abcde")
    assert (limited.most, unlimited.most) == (2, 5)


def test_an_executor_is_told_of_all_tasks_before_the_first(tmp_path):
    executor = Scripted(1)
    run(tmp_path, executor, *"abc")
    assert executor.prepared == ["a", "b", "c"]
    assert list(run_tasks([], None, tmp_path / "log")) == []


def test_a_line_that_a_killed_scheduler_left_is_not_read(tmp_path):
    run(tmp_path, Scripted(), "a")
    with (tmp_path / "log").open("a") as file:
        file.write(json.dumps({"key": "b"}))
    assert [each.key for each in read_attempts(tmp_path / "log")] == ["a"]
    assert read_attempts(tmp_path / "none") == []
