"""The input of a run."""

import re
from dataclasses import dataclass
from pathlib import Path

from spslam.config import Config

# Of a run's process beside what options bound: libraries, model, map, frames read ahead, and results being written.
_PROCESS_MB = 1500

_FRAMES = re.compile(r"(-?\d*):(-?\d*)(?::(\d+))?")


@dataclass(frozen=True)
class RunRequest:
    """A run over one sequence.

    Attributes:
        config: all options; `config.dataset` says how to read the data.
        data_dir: folder of the dataset; None for the generated room.
        output_dir: created if needed. It must be empty or, with `resume`, contain an interrupted run of the same
            request.
        frames: which frames of the dataset to process; None for all.
        resume: continue from the checkpoint in `output_dir` if there is one.
        mesh: whether to extract the mesh.
        map: output folder of a finished run in whose map the run goes on; None begins a new one.
        command: the command line of the run, for metrics.json and the report; empty where there was none.
    """

    config: Config
    data_dir: Path | None
    output_dir: Path
    frames: slice | None = None
    resume: bool = False
    mesh: bool = True
    map: Path | None = None
    command: str = ""


def memory_needed_mb(config: Config, mesh: bool) -> int:
    """Main memory in MB that a run is given on a shared machine: `pixels.budget_mb` and `mesh.max_memory_mb` count.

    Args:
        config: of the run.
        mesh: whether it makes one.
    """
    return round(_PROCESS_MB + config.pixels.budget_mb + (config.mesh.max_memory_mb if mesh else 0))


def parse_frames(text: str) -> slice:
    """Reads which frames to process.

    Args:
        text: `START:STOP[:STEP]`; each of the first two may be left out, negative ones count from the end.

    Raises:
        ValueError: anything else, or no frame selected whatever the length of the sequence.
    """
    match = _FRAMES.fullmatch(text)
    try:
        start, stop, step = (int(part) if part else None for part in match.groups()) if match else (None, None, 0)
    except ValueError:  # a lone minus sign
        step = 0
    if step == 0:
        raise ValueError(f"must be START:STOP[:STEP] with STEP at least 1, got {text!r}")
    if start is not None and stop is not None and (start < 0) == (stop < 0) and stop <= start:
        raise ValueError(f"must select at least one frame, got {text!r}")
    return slice(start, stop, step)
