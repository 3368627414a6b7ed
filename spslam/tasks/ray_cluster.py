"""Tasks on a Ray cluster (extra `cluster`)."""

from __future__ import annotations

import os
import shutil
import socket
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any

import spslam
from spslam.errors import ClusterError, OutputError, brief
from spslam.tasks.task import Needs, Task, TaskCall, TaskEnd

AUTO, LOCAL = "auto", "local"
CONNECT_S = 5.0  # within which a cluster's address must answer
NOTICE_S = 10.0  # without an end, after which it is looked at whether any node can run what waits
# A worker is busy with the process of its task, so that more of these threads cost nothing.
_READERS = 8


@dataclass(frozen=True)
class RayOptions:
    """How a cluster is used.

    Attributes:
        address: `HOST:PORT` of a running cluster that this machine belongs to, `auto` for the one that runs on this
            machine, or `local` to start Ray on this machine alone.
        workers: how many tasks run at a time; None for as many as there is room for.
        threads: kernel threads of each, and the cores that it takes; None for those of the smallest node, divided by
            its GPUs where these are used.
        always_copy: copy inputs to each node's disk even where their paths are there.
        cores: of a task without GPU where `threads` is None; None for those of the smallest node.
        notify: is told, in one line, what an operator may want to know.
    """

    address: str
    workers: int | None = None
    threads: int | None = None
    always_copy: bool = False
    cores: int | None = None
    notify: Callable[[str], None] = lambda _: None


class RayExecutor:
    """Runs tasks on a Ray cluster; a task takes cores, a GPU and memory of a node while it runs.

    Args:
        options: of the cluster.

    Raises:
        ClusterError: Ray is not installed, or there is no such cluster.
    """

    def __init__(self, options: RayOptions):
        self._ray = _imported()
        self._options, self.slots = options, options.workers
        self._is_own = not self._ray.is_initialized()
        if self._is_own:
            _connect(self._ray, options.address)
        try:
            # Imported late, since it needs Ray itself.
            from spslam.tasks.ray_node import FileServer, run_on_node

            self._function = self._ray.remote(run_on_node)
            self._server = self._ray.remote(FileServer).options(**self._beside_driver()).remote()
        except BaseException:
            self._disconnect()
            raise
        self._announced: set[str] = set()
        self._running: dict[Any, Task] = {}
        self._noticed = False

    @property
    def has_gpus(self) -> bool:
        """Whether a node has a GPU."""
        return any(node.get("GPU", 0) >= 1 for node in self._nodes())

    def prepare(self, tasks: Sequence[Task]) -> None:
        """Nothing is to be prepared: nodes, also those that come later, take what they have room for."""

    def start(self, task: Task) -> None:
        """Queues a task."""
        from spslam.tasks.ray_node import SentTask

        for path in task.inputs:
            if path not in self._announced:
                self._ray.get(self._server.announce.remote(path))
                self._announced.add(path)
        cpus = self._cpus(task.needs)
        call = TaskCall(task.function, task.arguments, Path(), cpus, self._simultaneous(task.needs, cpus))
        sent = SentTask(task.key, call, task.inputs, self._options.always_copy, spslam.__version__)
        needs = {"num_cpus": cpus, "num_gpus": task.needs.gpus, "memory": task.needs.memory_mb << 20}
        # The scheduler starts again what died, as it does elsewhere.
        reference = self._function.options(max_retries=0, **needs).remote(sent, self._server)
        self._running[reference] = task

    def wait(self) -> TaskEnd:
        """Waits for the next task that ends; says so where no node has what the waiting ones need."""
        while True:
            done, _ = self._ray.wait(list(self._running), num_returns=1, timeout=NOTICE_S)
            if done:
                return self._taken(done[0])
            self._notice_what_fits_nowhere()

    def __enter__(self) -> RayExecutor:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        for reference in self._running:
            self._ray.cancel(reference, force=True)
        self._ray.kill(self._server)
        self._disconnect()

    def _taken(self, reference: Any) -> TaskEnd:
        task = self._running.pop(reference)
        errors = self._ray.exceptions
        try:
            end, files = self._ray.get(reference)
        except errors.RayTaskError as error:
            return TaskEnd(task.key, f"on a node: {brief(str(error).strip().splitlines()[-1], 300)}")
        except errors.OutOfMemoryError:
            return TaskEnd(task.key, "its node ran out of memory", lost=True)
        except errors.NodeDiedError:
            return TaskEnd(task.key, "its node died", lost=True)
        except errors.WorkerCrashedError:
            return TaskEnd(task.key, "its worker died", lost=True)
        except errors.RayError as error:
            return TaskEnd(task.key, f"Ray lost it: {brief(str(error), 300)}", lost=True)
        if not end.error:
            _write(task.output, files)
        return end

    def _beside_driver(self) -> Mapping[str, Any]:
        from ray.util.scheduling_strategies import NodeAffinitySchedulingStrategy

        here = NodeAffinitySchedulingStrategy(self._ray.get_runtime_context().get_node_id(), soft=False)
        return {"num_cpus": 0, "max_concurrency": _READERS, "scheduling_strategy": here}

    def _nodes(self) -> list[dict[str, float]]:
        """Resources of the nodes that run tasks."""
        nodes = [node["Resources"] for node in self._ray.nodes() if node["Alive"]]
        return [node for node in nodes if node.get("CPU", 0) >= 1]

    def _cpus(self, needs: Needs) -> int:
        if self._options.threads:
            return self._options.threads
        nodes = self._nodes()
        if needs.gpus:
            shares = [node["CPU"] / node["GPU"] for node in nodes if node.get("GPU", 0) >= 1]
        else:
            shares = [node["CPU"] for node in nodes]
        share = max(int(min(shares, default=1)), 1)
        return share if needs.gpus else min(self._options.cores or share, share)

    def _simultaneous(self, needs: Needs, cpus: int) -> int:
        """How many such tasks a node may run at a time."""
        most = max((_room(node, needs, cpus) for node in self._nodes()), default=1)
        return max(min(most, self.slots or most), 1)

    def _notice_what_fits_nowhere(self) -> None:
        for task in self._running.values():
            cpus = self._cpus(task.needs)
            if not self._noticed and not any(_room(node, task.needs, cpus) for node in self._nodes()):
                self._noticed = True
                gpu = ", a GPU" if task.needs.gpus else ""
                self._options.notify(
                    f"{task.key} waits for a node with {cpus} free cores{gpu} and {task.needs.memory_mb} MB of memory; "
                    "no node of the cluster has that: add one, or lower --threads"
                )

    def _disconnect(self) -> None:
        if self._is_own:
            self._ray.shutdown()


def _room(node: Mapping[str, float], needs: Needs, cpus: int) -> int:
    """How many tasks a node has room for while it runs nothing."""
    rooms = [node.get("CPU", 0) // cpus]
    rooms += [node.get("GPU", 0) // needs.gpus] if needs.gpus else []
    rooms += [node.get("memory", 0) // (needs.memory_mb << 20)] if needs.memory_mb else []
    return int(min(rooms))


def _imported() -> Any:
    try:
        import ray
    except ImportError:
        raise ClusterError("--cluster needs Ray, which is not installed: pip install 'spslam[cluster]'") from None
    return ray


def _connect(ray: Any, address: str) -> None:
    quiet = {"log_to_driver": False, "logging_level": "ERROR"}
    if address == LOCAL:
        os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
        ray.init(include_dashboard=False, **quiet)
        return
    if address != AUTO:
        _check_answers(address)
    try:
        ray.init(address=address, **quiet)
    except (ConnectionError, RuntimeError, ValueError, OSError) as error:
        where = "on this machine" if address == AUTO else f"at {address} with this machine in it"
        raise ClusterError(
            f"there is no Ray cluster {where}; `ray start --head` starts one, and `ray start --address HOST:PORT` adds "
            f"a machine ({brief(str(error), 200)})"
        ) from None


def _check_answers(address: str) -> None:
    """Ray itself tries for a minute and ends the process."""
    host, _, port = address.rpartition(":")
    if not host or not port.isdecimal() or "/" in address:
        raise ClusterError(f"--cluster must be {AUTO}, {LOCAL} or HOST:PORT of a Ray cluster, got {address}")
    try:
        socket.create_connection((host, int(port)), CONNECT_S).close()
    except (OSError, OverflowError) as error:
        raise ClusterError(
            f"no Ray cluster answers at {address}: {getattr(error, 'strerror', None) or error}"
        ) from None


def _write(folder: Path, files: list[tuple[str, Any]]) -> None:
    """Puts a task's files into its folder, which appears at once."""
    part = folder.with_name(f".{folder.name}.part")
    try:
        shutil.rmtree(part, ignore_errors=True)
        part.mkdir(parents=True)
        for name, content in files:
            (part / name).parent.mkdir(parents=True, exist_ok=True)
            content.tofile(part / name)
        shutil.rmtree(folder, ignore_errors=True)
        part.rename(folder)
    except OSError as error:
        raise OutputError(f"{folder}: can't be written: {error.strerror or error}") from error
