"""Tasks in processes of this machine."""

import time

import pytest

from spslam.tasks import child, local, machine
from spslam.tasks.local import LocalExecutor
from spslam.tasks.schedule import RETRIES, read_attempts, run_tasks
from tests.tasks.examples import task, wait_for


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
        wait_for(lambda: list((tmp_path / "begun").iterdir()), "the begin of the task")
        started = time.monotonic()
    assert time.monotonic() - started < 30
    assert executor.wait().error == "ended by signal 9"


MADE_LESS = "docs/cluster.md says what a run takes, and what makes it less"


@pytest.mark.parametrize(
    ("workers", "tasks", "free_mb", "slots", "line"),
    [
        (None, 8, 64000, 4, None),  # one per two of eight cores
        (None, 3, 64000, 3, None),  # nobody asked for more
        (8, 3, 64000, 3, "3 run at a time instead of 8: there are no more"),
        (None, 8, 5999, 2, "2 run at a time instead of 4: each is given 2500 MB of memory, and 5999 MB are free"),
        (
            8,
            8,
            900,
            1,
            "one runs at a time and may not have enough: each is given 2500 MB of memory, and 900 MB are",
        ),
        (8, 8, None, 8, None),  # the system does not say
    ],
)
def test_no_more_run_than_there_are_and_than_memory_holds(tmp_path, monkeypatch, workers, tasks, free_mb, slots, line):
    monkeypatch.setattr(local, "core_count", lambda: 8)
    monkeypatch.setattr(local, "free_memory_mb", lambda: free_mb)
    told = []
    executor = LocalExecutor(workers, None, cores=2, notify=told.append)
    executor.prepare([task(tmp_path, str(number), memory_mb=2500) for number in range(tasks)])
    assert executor.slots == slots
    assert [each[: len(line or "")] for each in told] == ([line] if line else [])
    assert all("there are no more" in each or each.endswith(MADE_LESS) for each in told)


def test_runs_at_a_time_where_nobody_says_how_many(monkeypatch):
    monkeypatch.setattr(local, "core_count", lambda: 8)
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "2,5,6")
    assert LocalExecutor().slots == LocalExecutor(threads=1).slots == 1
    assert LocalExecutor(cores=2).slots == 4
    assert LocalExecutor(threads=3, cores=2).slots == 2
    assert LocalExecutor(use_gpus=True, cores=2).slots == 3
    assert LocalExecutor(5, use_gpus=True, cores=2).slots == 5


@pytest.mark.parametrize(
    ("groups", "files", "free_mb"),
    [
        ("0::/", {}, 4096),
        ("0::/a/b", {"a/memory.max": 3 << 30, "a/memory.current": 1 << 30, "a/b/memory.max": "max"}, 2048),
        (
            "0::/",
            {"memory.max": 3 << 30, "memory.current": 2 << 30, "memory.stat": f"anon 5\ninactive_file {1 << 29}\n"},
            1536,
        ),
        (
            "4:cpu,memory:/a\n0::/",
            {"memory/a/memory.limit_in_bytes": 2 << 30, "memory/a/memory.usage_in_bytes": 1 << 30},
            1024,
        ),
        ("0::/", {"memory.max": 1 << 30, "memory.current": 2 << 30}, 0),
    ],
)
def test_memory_that_is_free_is_that_of_machine_and_container(tmp_path, monkeypatch, groups, files, free_mb):
    monkeypatch.setattr(machine, "PROC", tmp_path / "proc")
    monkeypatch.setattr(machine, "CGROUPS", tmp_path / "cgroups")
    assert machine.free_memory_mb() is None
    (tmp_path / "proc/self").mkdir(parents=True)
    (tmp_path / "proc/meminfo").write_text("MemTotal: 9999999 kB\nMemAvailable:    4194304 kB\n")
    (tmp_path / "proc/self/cgroup").write_text(f"9:name=systemd:/\n{groups}\n")
    for name, content in files.items():
        (tmp_path / "cgroups" / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / "cgroups" / name).write_text(f"{content}\n")
    assert machine.free_memory_mb() == free_mb


def test_a_process_that_dies_before_it_reads_its_call_is_an_end(tmp_path, monkeypatch):
    monkeypatch.setattr(child, "MODULE", "spslam.no_such_module")
    begin = child.Child.__init__

    def ended(self, *arguments):
        begin(self, *arguments)
        self._process.wait()

    monkeypatch.setattr(child.Child, "__init__", ended)
    with LocalExecutor(1, 1) as executor:
        executor.start(task(tmp_path, "gone", padding="x" * 2**20))
        end = executor.wait()
    assert "No module named spslam.no_such_module" in end.error


def test_a_process_that_can_not_be_waited_for_is_lost(tmp_path, monkeypatch):
    def fail(self):
        raise OSError("no pipe")

    monkeypatch.setattr(local.Child, "wait", fail)
    with LocalExecutor(1, 1) as executor:
        executor.start(task(tmp_path, "gone", seconds=600))
        end = executor.wait()
    assert end.lost and "no pipe" in end.error
