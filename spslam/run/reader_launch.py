"""Starts the process that reads frames. Does not import torch: the new process loads it while this one does the same.

See `reader_process` for the protocol and `reader_service` for what the process runs.
"""

import os
import subprocess
import sys
from dataclasses import dataclass
from multiprocessing import Pipe
from multiprocessing.connection import Connection
from pathlib import Path

from spslam.config import Config

# What the process runs. By name, as importing the module here would load torch; a test checks that it exists.
SERVICE_MODULE, SERVICE_FUNCTION = "spslam.run.reader_service", "serve"
# Device files of NVIDIA's driver: under Linux, and under Linux inside Windows (WSL).
_GPU_DRIVERS = (Path("/dev/nvidiactl"), Path("/dev/dxg"))
# Frames at a time: one that is read, one that waits for one before it, and one that is sent.
AHEAD_PER_WORKER = 3
_ENVIRONMENT = {
    "CUDA_VISIBLE_DEVICES": "",
    # NumPy's library would start threads, which a process that forks workers must not have.
    "OPENBLAS_NUM_THREADS": "1",
    "MKL_NUM_THREADS": "1",
    "OMP_NUM_THREADS": "1",
    # glibc keeps the memory of freed images; otherwise each image would page-fault its memory anew.
    "MALLOC_MMAP_THRESHOLD_": str(32 << 20),
    "MALLOC_TRIM_THRESHOLD_": str(256 << 20),
}


@dataclass(frozen=True)
class LaunchedReader:
    """A process that waits for its work.

    Attributes:
        process: the process.
        connection: socket to the process.
        shared: file descriptor of shared memory, empty as yet, that both processes have open.
    """

    process: subprocess.Popen
    connection: Connection
    shared: int


def launch() -> LaunchedReader:
    """Starts a reader process; it ends when its connection is closed.

    Raises:
        OSError, TypeError: the process can't be started.
    """
    shared = os.memfd_create("spslam-frames")
    own, other = Pipe()
    code = (
        "from spslam.loading import collector_paused\n"
        f"with collector_paused(): from {SERVICE_MODULE} import {SERVICE_FUNCTION}\n"
        f"{SERVICE_FUNCTION}({other.fileno()}, {shared})"
    )
    try:
        process = subprocess.Popen(
            [sys.executable, "-c", code],
            stdin=subprocess.DEVNULL,
            pass_fds=(other.fileno(), shared),
            # What can be imported here can be imported there.
            env={**os.environ, **_ENVIRONMENT, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))},
            # Ctrl-C reaches the frame loop only, which then ends the process.
            start_new_session=True,
        )
    except BaseException:
        own.close()
        os.close(shared)
        raise
    finally:
        other.close()
    return LaunchedReader(process, own, shared)


_standby: list[LaunchedReader] = []


def launch_standby(config: Config) -> None:
    """Starts a standby reader if the run will probably use one: early, as loading torch takes seconds."""
    run_wants_it = config.run.reader == "process" or (
        config.run.reader == "auto" and config.device != "cpu" and any(driver.exists() for driver in _GPU_DRIVERS)
    )
    if run_wants_it and not _standby:
        try:
            _standby.append(launch())
        except (OSError, TypeError):
            return


def has_standby() -> bool:
    """Whether there is a standby reader."""
    return bool(_standby)


def take_standby() -> LaunchedReader | None:
    """The standby reader, which is then no longer on standby; None where there is none."""
    return _standby.pop() if _standby else None


def end_standby() -> None:
    """Ends the standby reader if no run took it."""
    standby = take_standby()
    if standby is not None:
        standby.connection.close()
        os.close(standby.shared)
        standby.process.kill()
        standby.process.wait()
