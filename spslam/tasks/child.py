"""The process of one task: how it is started, ended and asked what went wrong."""

from __future__ import annotations

import contextlib
import importlib
import json
import os
import subprocess
import sys
import threading
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path

import spslam
from spslam.tasks.task import TaskCall

# Run with `-m`; reads a call from the first line of its input and ends when its input does.
MODULE = "spslam.cli.task"


def environment(changes: Mapping[str, str]) -> dict[str, str]:
    """Environment variables of a task's process: those of this process, where spslam is imported from, and changes."""
    paths = [str(Path(spslam.__file__).parent.parent), *os.environ.get("PYTHONPATH", "").split(os.pathsep)]
    # Spinning OpenMP threads of small_gicp would take cores from the reading threads.
    common = {"OMP_WAIT_POLICY": "passive", "PYTHONPATH": os.pathsep.join(path for path in paths if path)}
    return {**os.environ, **common, **changes}


class Child:
    """The process of a task. It ends at the latest when this process does.

    Args:
        call: what it does.
        variables: its environment.
    """

    def __init__(self, call: TaskCall, variables: Mapping[str, str]):
        call.output.mkdir(parents=True, exist_ok=True)
        self._lock = threading.Lock()
        self._process = subprocess.Popen(
            [sys.executable, "-m", MODULE],
            env=dict(variables),
            stdin=subprocess.PIPE,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
        )
        self._call = call

    def wait(self) -> tuple[str, bool]:
        """Waits for the end: what went wrong in one line, empty if nothing did, and whether the process was killed."""
        process = self._process
        try:
            if process.stdin is not None:
                line = json.dumps({**asdict(self._call), "output": str(self._call.output)}) + "\n"
                try:
                    process.stdin.write(line.encode())
                    process.stdin.flush()
                except BrokenPipeError:
                    pass  # it has ended already and says why
            errors = process.stderr.read().decode(errors="replace") if process.stderr else ""
            code = process.wait()
        finally:
            for stream in (process.stdin, process.stderr):
                if stream:
                    with contextlib.suppress(BrokenPipeError):  # closing writes what is left of a call that nobody read
                        stream.close()
        if code == 0:
            return "", False
        if code < 0:
            return f"ended by signal {-code}", True
        lines = errors.strip().splitlines()
        return (lines[-1].removeprefix("spslam: ") if lines else f"ended with code {code}"), False

    def kill(self) -> None:
        """Ends the process at once."""
        self._process.kill()


def call_of_line(line: str) -> TaskCall:
    """The call that `Child` writes."""
    values = json.loads(line)
    return TaskCall(**{**values, "output": Path(values["output"])})


def execute(call: TaskCall) -> None:
    """Calls the function of a task in this process; raises what it raises."""
    module, _, name = call.function.partition(":")
    getattr(importlib.import_module(module), name)(call)
