"""The input of a run."""

from dataclasses import dataclass
from pathlib import Path

from spslam.config import Config


@dataclass(frozen=True)
class RunRequest:
    """A run over one sequence.

    Attributes:
        config: all options; `config.dataset` says how to read the data.
        data_dir: folder of the dataset; None for the generated room.
        output_dir: created if needed. It must be empty or, with `resume`, hold an interrupted run of the same request.
        frames: which frames of the dataset to process; None for all.
        resume: continue from the checkpoint in `output_dir` if there is one.
        mesh: whether to extract the mesh.
    """

    config: Config
    data_dir: Path | None
    output_dir: Path
    frames: slice | None = None
    resume: bool = False
    mesh: bool = True
