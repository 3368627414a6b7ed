"""A task, what it needs, and how it ended: what the scheduler and its executors share."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from types import TracebackType
from typing import Any, Protocol


@dataclass(frozen=True)
class Needs:
    """What a task needs of a machine while it runs, beside cores, of which the executor gives all tasks equally many.

    Attributes:
        gpus: 0 or 1.
        memory_mb: main memory.
    """

    gpus: int = 0
    memory_mb: int = 0


@dataclass(frozen=True)
class Task:
    """One call of a function in a process of its own.

    Attributes:
        key: name of the task, also in file names.
        function: `module:name` of a function that takes a `TaskCall`.
        arguments: JSON object for the function.
        output: folder that holds what the function wrote when the task has ended well.
        needs: of a machine.
        inputs: absolute paths of the files and folders that the function reads.
    """

    key: str
    function: str
    arguments: Mapping[str, Any]
    output: Path
    needs: Needs = Needs()
    inputs: tuple[str, ...] = ()


@dataclass(frozen=True)
class TaskCall:
    """What the function of a task is called with.

    Attributes:
        function: `module:name` of the function.
        arguments: of the task.
        output: folder to write into; exists, and may hold files of an attempt that was killed on this machine.
        threads: kernel threads.
        simultaneous: how many such tasks may run on this machine at a time.
        paths: where this machine has the task's inputs, if not where the task says.
    """

    function: str
    arguments: Mapping[str, Any]
    output: Path
    threads: int
    simultaneous: int
    paths: Mapping[str, str] = field(default_factory=dict)

    def local(self, path: str | None) -> str | None:
        """Where this machine has an input; None for None."""
        return None if path is None else self.paths.get(path, path)


@dataclass(frozen=True)
class TaskEnd:
    """How one attempt at a task ended.

    Attributes:
        key: of the task.
        error: why it failed, in one line; empty where it did not.
        lost: whether the process or its machine died, so that another attempt may succeed.
        node: where it ran; empty where that is not known.
        seconds: how long the attempt took, waiting for a machine not included.
        attempt: its number, from 1.
    """

    key: str
    error: str = ""
    lost: bool = False
    node: str = ""
    seconds: float = 0.0
    attempt: int = 1


class Executor(Protocol):
    """Runs tasks. Used as a context; leaving it ends all tasks that are still running.

    Attributes:
        slots: how many tasks are started at a time, once it is prepared; None for all.
    """

    @property
    def slots(self) -> int | None: ...

    def prepare(self, tasks: Sequence[Task]) -> None:
        """Is told of all tasks, of which there is at least one, before the first is started."""

    def start(self, task: Task) -> None:
        """Begins a task, or puts it into a queue; returns at once."""

    def wait(self) -> TaskEnd:
        """Waits for the next attempt that ends. At least one must have been started and not been waited for."""

    def __enter__(self) -> Executor: ...

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None: ...
