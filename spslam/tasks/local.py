"""Tasks in processes of this machine, one per GPU where there are several."""

from __future__ import annotations

import os
import queue
import threading
import time
from types import TracebackType

import torch

from spslam.tasks.child import Child, environment
from spslam.tasks.task import Task, TaskCall, TaskEnd


class LocalExecutor:
    """Runs tasks in processes of this machine.

    Memory is not divided: what `Needs.memory_mb` says counts on a cluster only.

    Args:
        workers: how many run at a time; None for one per GPU where they are used, else one.
        threads: kernel threads of each; None for an equal share of the processors.
        use_gpus: whether tasks need GPUs.
    """

    def __init__(self, workers: int | None = None, threads: int | None = None, use_gpus: bool = False):
        visible = os.environ.get("CUDA_VISIBLE_DEVICES")
        self._gpus = visible.split(",") if visible else [str(index) for index in range(torch.cuda.device_count())]
        self.slots: int = workers or (max(len(self._gpus), 1) if use_gpus else 1)
        self._threads = threads
        self._free = list(range(self.slots))
        self._ends: queue.Queue[tuple[int, TaskEnd]] = queue.Queue()
        self._running: dict[str, tuple[Child, threading.Thread]] = {}
        self._lock = threading.Lock()

    def start(self, task: Task) -> None:
        """Begins a task; there must be a slot left."""
        slot = self._free.pop(0)
        gpu = {"CUDA_VISIBLE_DEVICES": self._gpus[slot % len(self._gpus)]} if task.needs.gpus and self._gpus else {}
        threads = self._threads or max(1, (os.cpu_count() or 1) // self.slots)
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

    def _watch(self, slot: int, key: str, child: Child) -> None:
        started = time.monotonic()
        error, lost = child.wait()
        with self._lock:
            self._running.pop(key, None)
        self._ends.put((slot, TaskEnd(key, error, lost, seconds=time.monotonic() - started)))
