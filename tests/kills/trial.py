"""One trial: a run is killed with SIGKILL at a random moment, perhaps again while it resumes, and then finished.

Runs are forked from a process that has imported everything, so that a trial takes a second and not ten.
"""

from __future__ import annotations

import json
import os
import random
import shutil
import signal
import time
from dataclasses import dataclass
from pathlib import Path

import cv2
import safetensors
import torch

from spslam import ops
from spslam.datasets import registry
from spslam.run.sequence import RunRequest, run_sequence
from spslam.run_folder import RunFolder
from spslam.trajectory import Trajectory
from tests.system.sequences import Recorded, results, settings

FRAMES = 8
SETTINGS = ("device=cpu", "run.checkpoint_every=2", "run.previews=1", "mapping.first_iterations=10", "mapping.every=2")
MAX_KILLS = 3  # of one run
GIVE_UP_S = 300.0


@dataclass(frozen=True)
class Reference:
    """What a run leaves that nobody kills.

    Attributes:
        results: bytes of trajectory and map.
        seconds: that it takes.
    """

    results: tuple[bytes, bytes]
    seconds: float


def measure(folder: Path) -> Reference:
    """Runs to the end in a child. A child has none of the threads that OpenCV has here, and would wait for them."""
    ops.set_num_threads(1)
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    _run_in_child(folder / "warm-up", None)
    started = time.monotonic()
    _run_in_child(folder / "reference", None)
    return Reference(results(folder / "reference"), time.monotonic() - started)


def try_kills(folder: Path, seed: int, reference: Reference) -> tuple[int, list[str]]:
    """Kills a run up to `MAX_KILLS` times, checks what it left each time, and finishes it.

    Args:
        folder: for the run's output; removed where nothing was wrong.
        seed: of the moments.
        reference: what the finished run must hold.

    Returns:
        The number of kills, and what was wrong.
    """
    moments = random.Random(seed)
    kills, wrong = 0, []
    for _ in range(moments.randint(1, MAX_KILLS)):
        if _run_in_child(folder, moments.uniform(0.0, 1.1 * reference.seconds)) == 0:
            break
        kills += 1
        wrong += [f"seed {seed}, kill {kills}: {error}" for error in _unreadable(RunFolder(folder))]
    code = _run_in_child(folder, None)
    if code != 0:
        wrong.append(f"seed {seed}: the resumed run ended with {code}")
    elif results(folder) != reference.results:
        wrong.append(f"seed {seed}: the resumed run has other results")
    wrong += [f"seed {seed}: left {path.name}" for path in folder.rglob("*") if ".tmp." in path.name]
    if not wrong:
        shutil.rmtree(folder)
    return kills, wrong


def _run_in_child(folder: Path, kill_after_s: float | None) -> int:
    """Starts or resumes the run in a child; returns its exit code, -9 where it was killed."""
    child = os.fork()
    if child == 0:
        code = 1
        try:
            registry.open_dataset = lambda *_: Recorded(FRAMES)
            run_sequence(RunRequest(settings(*SETTINGS), None, folder, resume=True))
            code = 0
        finally:
            os._exit(code)
    deadline = time.monotonic() + (GIVE_UP_S if kill_after_s is None else kill_after_s)
    while True:
        pid, status = os.waitpid(child, os.WNOHANG)
        if pid:
            return os.waitstatus_to_exitcode(status)
        if time.monotonic() >= deadline:
            os.kill(child, signal.SIGKILL)
            os.waitpid(child, 0)
            return -signal.SIGKILL
        time.sleep(0.002)


def _unreadable(folder: RunFolder) -> list[str]:
    """What is wrong with the files that a killed run left. Only a log may end in the middle of a line."""
    wrong = []
    readers = {
        folder.config: Path.read_text,
        folder.log: _read_rows,
        folder.checkpoint: _read_tensors,
        folder.map: _read_tensors,
        folder.trajectory: Trajectory.load_tum,
        folder.metrics: lambda path: json.loads(path.read_text()),
        folder.report: _read_page,
        folder.preview_camera: lambda path: json.loads(path.read_text()),
    }
    for path, read in readers.items():
        if path.exists():
            try:
                read(path)
            except Exception as error:  # whatever it is, the file can't be read
                wrong.append(f"{path.name} is unreadable: {error!r}")
    return wrong


def _read_rows(path: Path) -> None:
    for line in path.read_text().splitlines(keepends=True):
        if line.endswith("\n"):
            json.loads(line)


def _read_tensors(path: Path) -> None:
    with safetensors.safe_open(path, framework="pt") as file:
        for name in file.keys():  # noqa: SIM118 - not a dict
            file.get_tensor(name)


def _read_page(path: Path) -> None:
    if not path.read_text().rstrip().endswith("</html>"):
        raise ValueError("ends early")
