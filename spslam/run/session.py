"""A run from its start, or from its last checkpoint: where it begins and what it continues."""

import hashlib
import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from spslam.config import dump_config, load_config
from spslam.datasets.base import RgbdDataset
from spslam.errors import ConfigError, OutputError
from spslam.io import atomic_write
from spslam.run.clock import RunClock
from spslam.run.output_folder import OutputFolder
from spslam.run.provenance import provenance
from spslam.run.request import RunRequest
from spslam.run_folder import RunFolder
from spslam.slam.checkpoint import fingerprint, load_checkpoint
from spslam.slam.system import SlamSystem


@dataclass(frozen=True)
class RunSession:
    """One execution of a run; an interrupted run has several.

    Attributes:
        folder: for the results.
        identity: JSON object that identifies the frames; a checkpoint is only resumed with the same ones.
        total: number of frames of the whole run.
        start: position of the first frame to process.
        clock: continues the earlier sessions'.
        warnings: doubts about the data, from a look at the first frames.
    """

    folder: OutputFolder
    identity: dict[str, Any]
    total: int
    start: int
    clock: RunClock
    warnings: Sequence[str] = ()


def open_session(
    request: RunRequest, dataset: RgbdDataset, system: SlamSystem, warnings: Sequence[str] = ()
) -> RunSession:
    """Creates the output folder, or restores the system from the folder's checkpoint.

    Args:
        request: of the run.
        dataset: its frames.
        system: new; its state is restored from the checkpoint if the request resumes one.
        warnings: doubts about the data.

    Raises:
        OutputError: the folder can't be used, or its checkpoint belongs to another run.
    """
    folder, identity = OutputFolder(Path(request.output_dir)), identity_of(dataset, request)
    if request.resume and folder.checkpoint.exists():
        saved = load_checkpoint(folder.checkpoint, system.state, system.config)
        if saved["data"] != identity:
            raise OutputError(f"{folder.path}: belongs to a run over other data or frames; use another --output")
        folder.remove_temporaries()
        folder.truncate_log(system.state.frames.processed, saved["next"])
        return RunSession(folder, identity, len(dataset), saved["next"], RunClock(**saved["clock"]), warnings)
    folder.create(request.resume)
    atomic_write(folder.config, dump_config(system.config, provenance(system.config, system.device)))
    return RunSession(folder, identity, len(dataset), 0, RunClock(), warnings)


def finished_metrics(request: RunRequest, dataset: RgbdDataset) -> dict[str, Any] | None:
    """metrics.json of the finished run that the request would resume; None where there is something left to do.

    Raises:
        OutputError: the folder holds a finished run of other options, data or frames.
    """
    folder = OutputFolder(Path(request.output_dir))
    if not request.resume or not folder.is_finished:
        return None
    try:
        metrics = json.loads(folder.metrics.read_text(encoding="utf-8"))
        same = fingerprint(load_config(folder.config)) == fingerprint(request.config)
        same = same and metrics["data"] == identity_of(dataset, request)
    except (OSError, ValueError, KeyError, TypeError, ConfigError):
        same = False
    if not same:
        raise OutputError(f"{folder.path}: holds a finished run of other options, data or frames; use another --output")
    if not folder.report.is_file():  # killed just before the end: all that it is made of is there
        folder.write_report()
    return metrics


def identity_of(dataset: RgbdDataset, request: RunRequest) -> dict[str, Any]:
    """JSON object that identifies the frames of a run, and the map that it goes on in."""
    opened = {} if request.map is None else {"map": _digest(RunFolder(request.map).keyframes)}
    return {
        **opened,
        "folder": str(Path(request.data_dir).resolve()) if request.data_dir else "",
        "frames": len(dataset),
        "timestamps": hashlib.sha256(dataset.timestamps().tobytes()).hexdigest()[:16],
    }


def _digest(path: Path) -> str:
    """Identifies the content of a file."""
    try:
        return hashlib.sha256(path.read_bytes()).hexdigest()[:16]
    except OSError as error:
        raise OutputError(f"{path}: can't be read: {error.strerror or error}") from None
