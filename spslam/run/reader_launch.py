"""Starting the process that reads frames; without torch, so that it can load torch while this process does the same."""

import os
import subprocess
import sys
from dataclasses import dataclass
from multiprocessing import Pipe
from multiprocessing.connection import Connection
from pathlib import Path

from spslam.config import Config

# NVIDIA's driver, and the one of Windows under Linux.
_GPU_DRIVERS = (Path("/dev/nvidiactl"), Path("/dev/dxg"))
_ENVIRONMENT = {
    "CUDA_VISIBLE_DEVICES": "",
    # glibc keeps the memory of images that were let go; each frame's would come page by page else.
    "MALLOC_MMAP_THRESHOLD_": str(32 << 20),
    "MALLOC_TRIM_THRESHOLD_": str(256 << 20),
}


@dataclass(frozen=True)
class LaunchedReader:
    """A process that waits for its work.

    Attributes:
        process: it.
        connection: to it.
        shared: file descriptor of memory, empty as yet, that it has too.
    """

    process: subprocess.Popen
    connection: Connection
    shared: int


def launch() -> LaunchedReader:
    """Starts a process that reads; it ends when its connection does. Raises OSError or TypeError where none can be."""
    shared = os.memfd_create("spslam-frames")
    own, other = Pipe()
    code = f"from spslam.run.reader_service import serve; serve({other.fileno()}, {shared})"
    try:
        process = subprocess.Popen(
            [sys.executable, "-c", code],
            stdin=subprocess.DEVNULL,
            pass_fds=(other.fileno(), shared),
            # What is importable here must be there.
            env={**os.environ, **_ENVIRONMENT, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))},
            # Ctrl-C is for the loop, which ends it.
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
    """Starts the process for the run to come, if it is likely to want one: early, as it takes seconds to load torch."""
    run_wants_it = config.run.reader == "process" or (
        config.run.reader == "auto" and config.device != "cpu" and any(driver.exists() for driver in _GPU_DRIVERS)
    )
    if run_wants_it and not _standby:
        try:
            _standby.append(launch())
        except (OSError, TypeError):
            return


def has_standby() -> bool:
    """Whether `take_standby` would give one."""
    return bool(_standby)


def take_standby() -> LaunchedReader | None:
    """The process that `launch_standby` started, once."""
    return _standby.pop() if _standby else None


def end_standby() -> None:
    """Ends what nobody took."""
    spare = take_standby()
    if spare is not None:
        spare.connection.close()
        os.close(spare.shared)
        spare.process.kill()
        spare.process.wait()
