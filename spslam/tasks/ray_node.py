"""What runs on the nodes of a Ray cluster: a task's process, its inputs and its output.

Ray sends these functions by name, so every node needs the same spslam installed.
"""

from __future__ import annotations

import os
import shutil
import socket
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import ray

import spslam
from spslam.errors import SpslamError
from spslam.tasks.child import Child, environment
from spslam.tasks.node_data import Listing, file_names, list_files, local_input, read_part
from spslam.tasks.task import TaskCall, TaskEnd

Files = list[tuple[str, np.ndarray]]


@dataclass(frozen=True)
class SentTask:
    """A task as it is sent to a node.

    Attributes:
        key: of the task.
        call: without folder and paths, which are the node's.
        inputs: of the task.
        always_copy: inputs, even where their paths are there.
        version: of spslam that sends it.
    """

    key: str
    call: TaskCall
    inputs: Sequence[str]
    always_copy: bool
    version: str


class FileServer:
    """An actor on the machine that sends the tasks: reads the inputs that were announced to it, and nothing else."""

    def __init__(self) -> None:
        self._listings: dict[str, Listing] = {}

    def announce(self, path: str) -> None:
        """Lets nodes read an input."""
        self._listings.setdefault(path, list_files(Path(path)))

    def listing(self, path: str) -> Listing:
        """The files of an input, as they were when it was announced."""
        return self._listings[path]

    def read(self, path: str, name: str, offset: int, count: int) -> np.ndarray:
        """Bytes of a file of an input."""
        if not any(name == each.name for each in self._listings.get(path, ())):
            raise PermissionError(f"{path}/{name}: was not announced")
        return read_part(Path(path), name, offset, count)


def run_on_node(sent: SentTask, server: Any) -> tuple[TaskEnd, Files]:
    """Runs a task in a process of its own on this node.

    Args:
        sent: the task.
        server: handle of the `FileServer`.

    Returns:
        How it ended, and the files that it wrote, by their paths in its folder; none where it failed.
    """
    node, started = socket.gethostname(), time.monotonic()
    node = f"{node} {ray.get_runtime_context().get_node_id()[:8]}"
    end = TaskEnd(sent.key, node=node)
    if spslam.__version__ != sent.version:
        text = f"spslam {spslam.__version__} is installed there, {sent.version} where the tasks come from"
        return replace(end, error=f"node {node}: {text}"), []
    files: Files = []
    try:
        paths = {path: str(_fetched(path, sent, server)) for path in sent.inputs}
        folder = _scratch()
        try:
            call = replace(sent.call, output=folder, paths=paths)
            error, lost = Child(call, _environment()).wait()
            if not error:
                files = [(name, np.fromfile(folder / name, np.uint8)) for name in file_names(folder)]
            end = replace(end, error=error, lost=lost)
        finally:
            shutil.rmtree(folder, ignore_errors=True)
    except SpslamError as error:
        end = replace(end, error=f"node {node}: {error}")
    return replace(end, seconds=time.monotonic() - started), files


def _fetched(path: str, sent: SentTask, server: Any) -> Path:
    def read(name: str, offset: int, count: int) -> np.ndarray:
        return ray.get(server.read.remote(path, name, offset, count))

    return local_input(path, ray.get(server.listing.remote(path)), read, sent.always_copy)


def _environment() -> dict[str, str]:
    """That of the process, as outside of Ray, which sets the number of OpenMP's threads to the cores of the task."""
    variables = environment({})
    variables.pop("OMP_NUM_THREADS", None)
    return variables


def _scratch() -> Path:
    """A new folder for a task's output; those of workers that were killed are removed."""
    root = Path(tempfile.gettempdir()) / f"spslam-tasks-{os.getuid()}"
    root.mkdir(mode=0o700, exist_ok=True)
    for folder in root.iterdir():
        owner = folder.name.partition("-")[0]
        if owner.isdecimal() and not Path("/proc", owner).exists():
            shutil.rmtree(folder, ignore_errors=True)
    return Path(tempfile.mkdtemp(prefix=f"{os.getpid()}-", dir=root))
