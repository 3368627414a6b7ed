"""Starts the process that solves the keyframe graph. Does not import torch: the new process loads it meanwhile.

See `solver_process` for the protocol and `solver_service` for what the process runs.
"""

from spslam.helper_process import HelperProcess, Standby

# What the process runs; a test checks that it exists.
SERVICE_MODULE, SERVICE_FUNCTION = "spslam.slam.graph.solver_service", "serve"


def launch() -> HelperProcess:
    """Starts a process that solves graphs of one run after another; raises OSError, TypeError where it can't be."""
    return HelperProcess.launch(SERVICE_MODULE, SERVICE_FUNCTION)


SOLVERS = Standby(launch)
