"""Starts the process that reads frames. Does not import torch: the new process loads it while this one does the same.

See `reader_process` for the protocol and `reader_service` for what the process runs.
"""

import os
import subprocess
from dataclasses import dataclass
from multiprocessing.connection import Connection

from spslam.helper_process import HelperProcess, Standby
from spslam.run.memory import LARGEST_KEPT, MOST_KEPT

# What the process runs; a test checks that it exists.
SERVICE_MODULE, SERVICE_FUNCTION = "spslam.run.reader_service", "serve"
# Frames at a time: one that is read, one that waits for one before it, and one that is sent.
AHEAD_PER_WORKER = 3
READER_ENVIRONMENT = {
    "OMP_NUM_THREADS": "1",
    "MALLOC_MMAP_THRESHOLD_": str(LARGEST_KEPT),
    "MALLOC_TRIM_THRESHOLD_": str(MOST_KEPT),
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

    def end(self) -> None:
        """Ends the process, which was given no work."""
        os.close(self.shared)
        HelperProcess(self.process, self.connection).end()


def launch() -> LaunchedReader:
    """Starts a reader process; it ends when its connection is closed.

    Raises:
        OSError, TypeError: the process can't be started.
    """
    shared = os.memfd_create("spslam-frames")
    try:
        helper = HelperProcess.launch(SERVICE_MODULE, SERVICE_FUNCTION, READER_ENVIRONMENT, (shared,))
    except BaseException:
        os.close(shared)
        raise
    return LaunchedReader(helper.process, helper.connection, shared)


READERS = Standby(launch)
