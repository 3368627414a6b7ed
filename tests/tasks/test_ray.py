"""A Ray cluster of two nodes on this machine: the figures of one machine, lost workers, a node that comes later."""

import os
import signal

import pytest

import spslam
from spslam.benchmark.records import run_jobs
from spslam.config import load_config
from spslam.errors import ClusterError
from spslam.run.chunks import ChunkOptions, run_chunks
from spslam.run.request import RunRequest
from spslam.tasks.ray_cluster import RayExecutor, RayOptions
from spslam.tasks.schedule import LOG, read_attempts, run_tasks
from spslam.tasks.task import Needs, Task
from tests.benchmark.examples import tiny_job
from tests.cli.command import ROOT
from tests.system.test_maps import SETTINGS
from tests.tasks.examples import InThisProcess, task, wait_for

ray = pytest.importorskip("ray", reason="Ray is not installed: pip install 'spslam[cluster]'")

# `test_schedule.py` and `test_local.py` are without a cluster, and `test_node_data.py` without Ray.
pytestmark = pytest.mark.sweep

NODE = {"num_cpus": 1, "memory": 8 << 30, "object_store_memory": 80 << 20}
TIMED = ("fps", "_ms", "_s", "_per_iteration", "_rss_mb")  # ends of the names of what differs from run to run


@pytest.fixture(scope="module")
def cluster():
    """Two nodes of one core each."""
    from ray.cluster_utils import Cluster

    names = {"RAY_USAGE_STATS_ENABLED": "0", "PYTHONPATH": str(ROOT)}
    before = {name: os.environ.get(name) for name in names}
    os.environ.update(names)
    made = Cluster(initialize_head=True, head_node_args={**NODE, "include_dashboard": False})
    made.add_node(**NODE)
    ray.init(address=made.address, log_to_driver=False, logging_level="ERROR")
    yield made
    ray.shutdown()
    made.shutdown()
    for name, value in before.items():
        if value is None:
            del os.environ[name]
        else:
            os.environ[name] = value


def executor(cluster, **options):
    return RayExecutor(RayOptions(cluster.address, **{"threads": 1, **options}))


def untimed(record):
    return {name: value for name, value in record["figures"].items() if not name.endswith(TIMED)}


def test_a_suite_has_the_figures_of_one_machine(cluster, tmp_path):
    """Six short runs on two nodes; one worker is killed while its run goes on, which costs one retry."""
    coarse = (*tiny_job().options, ("mesh.resolution_m", 0.05))
    jobs = {job.key(): job for seed in range(6) if (job := tiny_job(seed=seed, options=coarse))}
    killed = []

    def kill_one():
        """Kills a worker that runs something, where one does: between two runs there may be none."""
        running = [pid for pid in worker_processes() if children(pid)]
        for pid in running[:1]:
            killed.append(pid)
            os.kill(pid, signal.SIGKILL)
        return running

    def kill(done, total, outcome):
        if not killed:
            wait_for(kill_one, "a run in a worker")

    with executor(cluster) as on_cluster:
        found = run_jobs(jobs, tmp_path / "cluster", on_cluster, report=kill)
    expected = run_jobs(jobs, tmp_path / "local", InThisProcess())
    assert not [outcome.error for outcome in found.values() if outcome.error]
    for key in jobs:
        assert untimed(found[key].record) == untimed(expected[key].record)
        assert found[key].record["job"] == expected[key].record["job"]
        environments = [each[key].record["environment"] for each in (found, expected)]
        assert environments[0] == {**environments[1], "kernel_threads": 1}
    attempts = read_attempts(tmp_path / "cluster" / LOG)
    assert [attempt.error for attempt in attempts if attempt.lost] == ["its worker died"]
    assert len(attempts) == 7 and len({attempt.node for attempt in attempts if attempt.node}) == 2
    again = run_jobs(jobs, tmp_path / "cluster", None)
    assert all(outcome.earlier for outcome in again.values())


def test_chunks_are_those_of_one_machine(cluster, tmp_path):
    def run(name, on):
        config = load_config("places", None, [*SETTINGS, "mesh.source=neural"])
        with on:
            return run_chunks(RunRequest(config, None, tmp_path / name, slice(0, 24)), ChunkOptions(2, 8), on)

    metrics = run("cluster", executor(cluster))
    run("local", InThisProcess())
    assert metrics["frames"] == 24 and metrics["chunks"] == 2 and metrics["lost_frames"] == 0
    for name in ("trajectory.txt", "map.safetensors", "keyframes.safetensors"):
        assert (tmp_path / "cluster" / name).read_bytes() == (tmp_path / "local" / name).read_bytes(), name


def worker_processes():
    """Processes of Ray's workers that run tasks of spslam."""
    return [pid for pid in processes() if "ray::run_on_node" in command_line(pid)]


def children(pid):
    return [each for each in processes() if parent(each) == pid and "spslam.cli.task" in command_line(each)]


def processes():
    return [int(name) for name in os.listdir("/proc") if name.isdecimal()]


def command_line(pid):
    try:
        with open(f"/proc/{pid}/cmdline", "rb") as file:
            return file.read().replace(b"\0", b" ").decode(errors="replace")
    except OSError:
        return ""


def parent(pid):
    try:
        with open(f"/proc/{pid}/stat") as file:
            return int(file.read().rpartition(")")[2].split()[1])
    except OSError:
        return 0


def test_what_is_sent_comes_back(cluster, tmp_path):
    """A run's process has its inputs, though they are copied; what it wrote is there, and what fails is one line."""
    (tmp_path / "input").write_text("content")
    sent = Task("sent", "tests.tasks.functions:write", {"text": "sent"}, tmp_path / "sent", Needs(0, 100))
    sent = Task(**{**vars(sent), "inputs": (str(tmp_path / "input"),)})
    missing = Task(**{**vars(sent), "key": "missing", "inputs": ("/nowhere/at/all",)})
    with executor(cluster, always_copy=True) as on_cluster:
        tasks = [sent, missing, task(tmp_path, "wrong", "fail"), task(tmp_path, "absent", "no_such_function")]
        ends = {end.key: end.error for end in run_tasks(tasks, on_cluster, tmp_path / "log")}
    assert ends["sent"] == "" and ends["wrong"] == "wrong: no such thing"
    assert "/nowhere/at/all: no such file or folder" in ends["missing"]
    assert "no_such_function" in ends["absent"]
    assert (tmp_path / "sent" / "inputs").read_text() == "content"
    assert (tmp_path / "sent" / "below" / "text").read_text() == "sent"
    assert (tmp_path / "sent" / "empty").read_bytes() == b""
    assert not (tmp_path / "wrong").exists()


def test_another_version_is_refused(cluster, tmp_path, monkeypatch):
    monkeypatch.setattr(spslam, "__version__", "9.9")
    with executor(cluster) as on_cluster:
        end = next(run_tasks([task(tmp_path, "new")], on_cluster, tmp_path / "log"))
    assert "is installed there, 9.9 where the tasks come from" in end.error


def test_a_node_that_comes_later_is_used(cluster, tmp_path):
    tasks = [task(tmp_path, f"task-{number}", seconds=1) for number in range(10)]
    added = []
    with executor(cluster) as on_cluster:
        for end in run_tasks(tasks, on_cluster, tmp_path / "log"):
            assert not end.error
            if not added:
                added.append(cluster.add_node(**NODE))
    assert len({attempt.node for attempt in read_attempts(tmp_path / "log")}) == 3
    cluster.remove_node(added[0])


def test_what_no_node_has_is_told(cluster, tmp_path, monkeypatch):
    from spslam.tasks import ray_cluster

    monkeypatch.setattr(ray_cluster, "NOTICE_S", 0.2)
    told = []

    def tell(line):
        told.append(line)
        raise KeyboardInterrupt

    with executor(cluster, threads=5, notify=tell) as on_cluster, pytest.raises(KeyboardInterrupt):
        list(run_tasks([task(tmp_path, "large")], on_cluster, tmp_path / "log"))
    assert told == [
        "large waits for a node with 5 free cores and 0 MB of memory; no node of the cluster has that: add one, or "
        "lower --threads"
    ]


def test_leaving_the_executor_ends_its_tasks(cluster, tmp_path):
    with executor(cluster) as on_cluster:
        on_cluster.start(task(tmp_path, "long", seconds=600))
        wait_for(lambda: any(children(pid) for pid in worker_processes()), "the begin of the task")
        running = [child for pid in worker_processes() for child in children(pid)]
    wait_for(lambda: not any("spslam.cli.task" in command_line(pid) for pid in running), "the end of the task")


@pytest.mark.parametrize(
    ("address", "message"),
    [
        ("127.0.0.1:1", "no Ray cluster answers at 127.0.0.1:1: Connection refused"),
        ("ray://somewhere:10001", "--cluster must be auto, local or HOST:PORT of a Ray cluster, got ray://"),
        ("somewhere", "--cluster must be auto, local or HOST:PORT"),
    ],
)
def test_an_address_without_a_cluster_is_refused(address, message):
    with pytest.raises(ClusterError, match=message):
        ray_connect(address)


def ray_connect(address):
    from spslam.tasks.ray_cluster import _connect

    _connect(ray, address)
