"""Processes that work for this one, each behind a connection. Imports no torch, so that they can be started before it.

A helper process runs one function of one module and ends when its connection is closed, for whatever reason. Loading
torch takes it seconds: a program that will probably need one starts it early, on standby.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from multiprocessing import Pipe
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Generic, Literal, Protocol, TypeVar

# Raised by a connection whose other end is closed.
DISCONNECTED = (EOFError, ConnectionError)
# Raised where a process can't be started.
NOT_STARTED = (OSError, AttributeError, TypeError)
# Device files of NVIDIA's driver: under Linux, and under Linux inside Windows (WSL).
_GPU_DRIVERS = (Path("/dev/nvidiactl"), Path("/dev/dxg"))
_ENVIRONMENT = {
    "CUDA_VISIBLE_DEVICES": "",
    # NumPy's library would start threads, which a process that forks workers must not have.
    "OPENBLAS_NUM_THREADS": "1",
    "MKL_NUM_THREADS": "1",
}


class Endable(Protocol):
    """What can be ended."""

    def end(self) -> None:
        """Ends it, whatever it does."""


_Helper = TypeVar("_Helper", bound=Endable)


@dataclass(frozen=True)
class HelperProcess:
    """A process that waits for its work.

    Attributes:
        process: the process.
        connection: socket to the process.
    """

    process: subprocess.Popen
    connection: Connection

    @classmethod
    def launch(
        cls, module: str, function: str, environment: Mapping[str, str] | None = None, shared: tuple[int, ...] = ()
    ) -> HelperProcess:
        """Starts a process.

        Args:
            module, function: what it runs, called with the file descriptors of its connection and of what is shared;
                by name, as importing the module here would load torch.
            environment: variables of its own.
            shared: file descriptors that it shares.

        Raises:
            OSError, TypeError: the process can't be started.
        """
        own, other = Pipe()
        descriptors = other.fileno(), *shared
        code = (
            "from spslam.loading import collector_paused\n"
            f"with collector_paused(): from {module} import {function}\n"
            f"{function}({', '.join(map(str, descriptors))})"
        )
        # What can be imported here can be imported there.
        path = {"PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
        try:
            process = subprocess.Popen(
                [sys.executable, "-c", code],
                stdin=subprocess.DEVNULL,
                pass_fds=descriptors,
                env={**os.environ, **_ENVIRONMENT, **(environment or {}), **path},
                # Ctrl-C reaches the frame loop only, which then ends the process.
                start_new_session=True,
            )
        except BaseException:
            own.close()
            raise
        finally:
            other.close()
        return cls(process, own)

    def end(self) -> None:
        """Kills the process, which has nothing to save."""
        self.connection.close()
        self.process.kill()
        self.process.wait()


class Standby(Generic[_Helper]):
    """At most one helper that is started before it is needed.

    Args:
        launch: starts one; raises `NOT_STARTED`.
    """

    def __init__(self, launch: Callable[[], _Helper]):
        self._launch = launch
        self.waiting: _Helper | None = None

    def prepare(self) -> None:
        """Starts one if there is none and the system can."""
        if self.waiting is None:
            try:
                self.waiting = self._launch()
            except NOT_STARTED:
                return

    def take(self) -> _Helper:
        """The one on standby, which then no longer is, or a new one; raises `NOT_STARTED`."""
        taken, self.waiting = self.waiting, None
        return self._launch() if taken is None else taken

    def give_back(self, helper: _Helper) -> None:
        """Puts one on standby that has done its work; ends it where there is another."""
        if self.waiting is None:
            self.waiting = helper
        else:
            helper.end()

    def end(self) -> None:
        """Ends the one on standby."""
        if self.waiting is not None:
            self.waiting.end()
            self.waiting = None


def describe_exit(code: int | None) -> str:
    """How a process ended, by its exit code; None where it has not."""
    return f"by {signal.Signals(-code).name}" if code is not None and code < 0 else f"with code {code}"


def is_probably_wanted(choice: Literal["auto", "process", "threads", "thread"], device: str) -> bool:
    """Whether a run will probably have a helper, by the value of an option: `auto` has one beside a GPU."""
    has_gpu = device != "cpu" and any(driver.exists() for driver in _GPU_DRIVERS)
    return choice == "process" or (choice == "auto" and has_gpu)
