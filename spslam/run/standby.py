"""Processes that a run will probably need, started early: loading torch takes them seconds."""

from spslam.config import Config
from spslam.helper_process import is_probably_wanted
from spslam.run.image_readers import IMAGE_READERS
from spslam.run.reader_launch import READERS
from spslam.slam.graph.solver_launch import SOLVERS


def launch_standby(config: Config, reads: bool = True, fuses: bool = False) -> None:
    """Starts those that a run with these options will probably need, and that are not there.

    Args:
        config: options of the run.
        reads: whether it reads a dataset.
        fuses: whether it makes a mesh, for which frames are read again.
    """
    if reads and is_probably_wanted(config.run.reader, config.device):
        READERS.prepare()
    if fuses and config.mesh.source == "tsdf":
        launch_image_readers(config, config.device)
    if config.graph.enabled and is_probably_wanted(config.run.graph_solver, config.device):
        SOLVERS.prepare()


def launch_image_readers(config: Config, device: str) -> None:
    """Starts those that read frames for a mesh, if a run with these options has processes that read and a GPU."""
    if config.run.reader != "threads" and is_probably_wanted("auto", device):
        IMAGE_READERS.prepare()


def end_standby() -> None:
    """Ends those that nothing took."""
    IMAGE_READERS.end()
    READERS.end()
    SOLVERS.end()
