"""A run from its start, or from its last checkpoint: where it begins and what it continues."""

import hashlib
import json
import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from spslam.config import Config, dump_config, load_config
from spslam.datasets.base import RgbdDataset
from spslam.datasets.mask import absolute_mask
from spslam.errors import ConfigError, DatasetError, OutputError
from spslam.io import atomic_write
from spslam.run.clock import RunClock
from spslam.run.output_folder import OutputFolder
from spslam.run.provenance import provenance
from spslam.run.request import RunRequest
from spslam.run_folder import RunFolder
from spslam.slam.checkpoint import fingerprint, load_checkpoint, read_source
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
    config = dump_config(with_absolute_path(system.config), provenance(system.config, system.device))
    if request.resume and folder.checkpoint.exists():
        _check_data(folder, identity)  # first, as states of other cameras can't be restored
        saved = load_checkpoint(folder.checkpoint, system.state, system.config)
        folder.remove_temporaries()
        folder.truncate_log(system.state.frames.processed, saved["next"])
        if _options_of(folder) != system.config:  # options that don't change the result so far may be others now
            atomic_write(folder.config, config)
        return RunSession(folder, identity, len(dataset), saved["next"], RunClock(**saved["clock"]), warnings)
    if request.resume and folder.trajectory.exists() and not _has_options(folder, request.config):
        raise OutputError(f"{folder.path}: holds results of a run with other options or data; use another --output")
    folder.create(request.resume)
    atomic_write(folder.config, config)
    return RunSession(folder, identity, len(dataset), 0, RunClock(), warnings)


def _check_data(folder: OutputFolder, identity: dict[str, Any]) -> None:
    """Raises OutputError where the checkpoint is of other data, frames or another camera."""
    saved = read_source(folder.checkpoint).get("data")
    if isinstance(saved, dict) and saved != identity:
        changed = [name.replace("_", " ") for name in identity | saved if saved.get(name) != identity.get(name)]
        raise OutputError(
            f"{folder.path}: belongs to a run over other data or frames ({', '.join(changed)} changed); "
            "use another --output"
        )


def _options_of(folder: OutputFolder) -> Config | None:
    """The options in the folder's config.yaml; None where they can't be read."""
    try:
        return load_config(folder.config)
    except ConfigError:
        return None


def _has_options(folder: OutputFolder, config: Config) -> bool:
    """Whether the run in a folder had the same data and options that decide its result."""
    earlier = _options_of(folder)
    same_data = earlier is not None and _path_of(earlier) == _path_of(config)
    return earlier is not None and same_data and fingerprint(earlier) == fingerprint(config)


def _path_of(config: Config) -> str | None:
    path = config.dataset.path
    return None if path is None else os.path.abspath(path)  # not what a link leads to: its name may tell the camera


def with_absolute_path(config: Config) -> Config:
    """The options as they hold in any working directory."""
    weights = config.prior.weights
    prior = config.prior.model_copy(update={"weights": None if weights is None else os.path.abspath(weights)})
    dataset = config.dataset.model_copy(update={"path": _path_of(config), "mask": absolute_mask(config.dataset.mask)})
    return config.model_copy(update={"dataset": dataset, "prior": prior})


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
        "camera": list(vars(dataset.camera).values()),
        "first_frame": _content(dataset),
    }


def _content(dataset: RgbdDataset) -> str:
    """Identifies the images of the first frame, and by them the scale of depth; empty where they can't be read."""
    try:
        frame = dataset[0]
    except DatasetError:
        return ""
    return hashlib.sha256(frame.depth.tobytes() + frame.color.tobytes()).hexdigest()[:16]


def _digest(path: Path) -> str:
    """Identifies the content of a file."""
    try:
        return hashlib.sha256(path.read_bytes()).hexdigest()[:16]
    except OSError as error:
        raise OutputError(f"{path}: can't be read: {error.strerror or error}") from None
