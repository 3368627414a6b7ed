"""Processes that a run will probably need, started early: loading torch takes them seconds."""

from spslam.config import Config
from spslam.helper_process import is_probably_wanted
from spslam.run.reader_launch import READERS
from spslam.slam.graph.solver_launch import SOLVERS


def launch_standby(config: Config, reads: bool = True) -> None:
    """Starts those that a run with these options will probably need, and that are not there.

    Args:
        config: options of the run.
        reads: whether it reads a dataset.
    """
    if reads and is_probably_wanted(config.run.reader, config.device):
        READERS.prepare()
    if config.graph.enabled and is_probably_wanted(config.run.graph_solver, config.device):
        SOLVERS.prepare()


def end_standby() -> None:
    """Ends those that no run took."""
    READERS.end()
    SOLVERS.end()
