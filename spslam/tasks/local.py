"""Tasks in processes of this machine, one per GPU where there are several."""

from __future__ import annotations

import os
import queue
import threading
import time
from collections.abc import Callable, Sequence
from types import TracebackType

import torch

from spslam.tasks.child import Child, environment
from spslam.tasks.machine import core_count, free_memory_mb
from spslam.tasks.task import Task, TaskCall, TaskEnd


class LocalExecutor:
    """Runs tasks in processes of this machine.

    Args:
        workers: how many run at a time; None for one per GPU where they are used, else one per `threads` or `cores`
            cores. Fewer run where there are fewer tasks, or not enough memory for as many.
        threads: kernel threads of each; None for an equal share of the cores.
        use_gpus: whether tasks need GPUs.
        cores: of a task without GPU where `threads` is None; None for all of the machine, whatever `threads` is.
        notify: is told, in one line, why fewer run at a time.
    """

    def __init__(
        self,
        workers: int | None = None,
        threads: int | None = None,
        use_gpus: bool = False,
        cores: int | None = None,
        notify: Callable[[str], None] = lambda _: None,
    ):
        visible = os.environ.get("CUDA_VISIBLE_DEVICES")
        self._gpus = visible.split(",") if visible else [str(index) for index in range(torch.cuda.device_count())]
        if use_gpus:
            most = max(len(self._gpus), 1)
        else:
            most = 1 if cores is None else max(core_count() // (threads or cores), 1)
        self._asked, self._most, self._threads, self._notify = workers, workers or most, threads, notify
        self._ends: queue.Queue[tuple[int, TaskEnd]] = queue.Queue()
        self._running: dict[str, tuple[Child, threading.Thread]] = {}
        self._lock = threading.Lock()
        self._set_slots(self._most)

    def prepare(self, tasks: Sequence[Task]) -> None:
        """Runs as many at a time as there is memory for, by what they need; none may be running."""
        wanted = min(self._most, len(tasks))
        needed, free = max(task.needs.memory_mb for task in tasks), free_memory_mb()
        room = wanted if free is None or not needed else free // needed
        self._set_slots(max(min(wanted, room), 1))
        if room < wanted:
            few = f"{room} run at a time instead of {wanted}" if room else "one runs at a time and may not have enough"
            self._notify(
                f"{few}: each is given {needed} MB of memory, and {free} MB are free; docs/cluster.md says what a run "
                "takes, and what makes it less"
            )
        elif self._asked is not None and wanted < self._asked:
            self._notify(f"{wanted} run at a time instead of {self._asked}: there are no more")

    def start(self, task: Task) -> None:
        """Begins a task; there must be a slot left."""
        slot = self._free.pop(0)
        gpu = {"CUDA_VISIBLE_DEVICES": self._gpus[slot % len(self._gpus)]} if task.needs.gpus and self._gpus else {}
        threads = self._threads or max(1, core_count() // self.slots)
        call = TaskCall(task.function, task.arguments, task.output, threads, self.slots)
        child = Child(call, environment(gpu))
        watcher = threading.Thread(target=self._watch, args=(slot, task.key, child), daemon=True)
        with self._lock:
            self._running[task.key] = child, watcher
        watcher.start()

    def wait(self) -> TaskEnd:
        """Waits for the next task that ends."""
        slot, end = self._ends.get()
        self._free.append(slot)
        return end

    def __enter__(self) -> LocalExecutor:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        with self._lock:
            running = list(self._running.values())
        for child, _ in running:
            child.kill()
        for _, watcher in running:
            watcher.join()

    def _set_slots(self, count: int) -> None:
        self.slots: int = count
        self._free = list(range(count))

    def _watch(self, slot: int, key: str, child: Child) -> None:
        started = time.monotonic()
        try:
            error, lost = child.wait()
        except Exception as failure:  # whatever it is: `wait` would never return
            child.kill()
            error, lost = f"its process can't be waited for: {failure}", True
        with self._lock:
            self._running.pop(key, None)
        self._ends.put((slot, TaskEnd(key, error, lost, seconds=time.monotonic() - started)))
