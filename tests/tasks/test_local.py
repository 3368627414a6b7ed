"""Tasks in processes of this machine."""

import time

import pytest

from spslam.tasks.local import LocalExecutor
from spslam.tasks.schedule import RETRIES, read_attempts, run_tasks
from tests.tasks.examples import task


@pytest.mark.slow
def test_tasks_end_well_fail_and_die(tmp_path):
    tasks = [
        task(tmp_path, "well"),
        task(tmp_path, "wrong", "fail"),
        task(tmp_path, "once", "die", once=True, marker=str(tmp_path / "m1")),
        task(tmp_path, "always", "die", marker=str(tmp_path / "m2")),
    ]
    with LocalExecutor(2, 1) as executor:
        ends = {end.key: end for end in run_tasks(tasks, executor, tmp_path / "log")}
    assert {key: end.error for key, end in ends.items()} == {
        "well": "",
        "wrong": "wrong: no such thing",
        "once": "",
        "always": f"ended by signal 9, as in each of {RETRIES + 1} attempts",
    }
    assert ends["once"].attempt == 2
    assert (tmp_path / "well/below/text").read_text() == "well"
    assert len(read_attempts(tmp_path / "log")) == 1 + 1 + 2 + RETRIES + 1


def test_leaving_the_executor_ends_its_tasks(tmp_path):
    (tmp_path / "begun").mkdir()
    with LocalExecutor(1, 1) as executor:
        executor.start(task(tmp_path, "long", seconds=600, begun=str(tmp_path / "begun")))
        while not list((tmp_path / "begun").iterdir()):
            time.sleep(0.05)
        started = time.monotonic()
    assert time.monotonic() - started < 30
    assert executor.wait().error == "ended by signal 9"
