"""Trains the scene prior: the point encoder and its geometry decoder together, on procedurally generated solids.

The loss is the mean over valid queries of `|tanh(s) - sdf/tr|`, with higher weights near the surface, plus a penalty on
the norm of the features. The networks work in voxel units, so one file can be used for every voxel size with the same
truncation in voxels. The decoder's weights of the position are fixed at 0, so that it ignores the position exactly. A
decoder trained with random positions ignores it only approximately, and its SDF is 6 % less accurate.
"""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path

import torch
from safetensors.torch import save

from spslam.io import atomic_write
from spslam.prior.shapes import TRAINING_KINDS
from spslam.prior.training import BatchGradient, PretrainSettings, TrainingPool, initial_networks, split_networks
from spslam.prior.training_state import TrainingState, load_state, save_state
from spslam.prior.validation import MM_PER_VOXEL, validate

SCRIPT_VERSION = 1
_LOG_EVERY, _VALIDATE_EVERY, _CHECKPOINT_EVERY = 100, 1000, 500
_ERROR_DECAY = 0.98

Progress = Callable[[int, int, float], None]


def pretrain(
    output: str | os.PathLike,
    settings: PretrainSettings | None = None,
    resume: bool = False,
    workers: int | None = None,
    progress: Progress | None = None,
) -> dict:
    """Trains encoder and decoder and writes them as one safetensors file, with their provenance.

    Also writes `<stem>.log.jsonl` (training error and validation) and, during the training,
    `<stem>.checkpoint.safetensors` beside `output`. The same settings give the same bytes on the same type of
    processor, whether interrupted or not and for any number of workers. On KeyboardInterrupt a checkpoint is written
    before the exception is raised again.

    Args:
        output: weights file to write.
        settings: `PretrainSettings()` by default.
        resume: resume from the checkpoint beside `output`; without a checkpoint, start from the beginning.
        workers: number of threads; the number of processors by default.
        progress: called with (completed steps, total steps, running mean error in mm at 4 cm voxels).

    Returns:
        The provenance: script version, settings, kinds of solids and validation metrics.

    Raises:
        WeightsError: the checkpoint is damaged or belongs to other settings.
        OutputError: a file cannot be written.
    """
    settings = settings or PretrainSettings()
    files = training_files(output)
    state = load_state(files.checkpoint, asdict(settings)) if resume and files.checkpoint.exists() else None
    state = state or TrainingState.start(initial_networks(settings.seed))
    log = _Log(files.log, state.step)
    with _one_torch_thread(), TrainingPool(workers or os.cpu_count() or 1, settings) as pool:
        try:
            for batch in pool.batches(state.step):
                next_state = _take_step(state, pool.gradient(state.parameters, batch), settings)
                _report(next_state, settings, log, progress)
                # Updated after the report, so that a step whose report was interrupted is repeated.
                state = next_state
                if state.step % _CHECKPOINT_EVERY == 0:
                    save_state(files.checkpoint, state, asdict(settings))
        except KeyboardInterrupt:
            save_state(files.checkpoint, state, asdict(settings))
            raise
        encoder_params, decoder_params = split_networks(state.parameters)
        provenance = {
            "script_version": SCRIPT_VERSION,
            "settings": asdict(settings),
            "training_kinds": list(TRAINING_KINDS),
            "validation": _validate(state, settings),
        }
    tensors = {"encoder": encoder_params.contiguous(), "geometry_decoder": decoder_params.contiguous()}
    atomic_write(files.weights, save(tensors, metadata={"prior": json.dumps(provenance, sort_keys=True)}))
    files.checkpoint.unlink(missing_ok=True)
    return provenance


@dataclass(frozen=True)
class TrainingFiles:
    """Files written by a training."""

    weights: Path
    log: Path
    checkpoint: Path
    plot: Path


def training_files(output: str | os.PathLike) -> TrainingFiles:
    """The files that belong to a weights file."""
    output = Path(output)
    suffixes = (".log.jsonl", ".checkpoint.safetensors", ".png")
    return TrainingFiles(output, *(output.with_suffix(suffix) for suffix in suffixes))


class _Log:
    """A log with one JSON object per line. Lines after `step` are removed, as these steps will be repeated."""

    def __init__(self, path: Path, step: int) -> None:
        self._path = path
        lines = path.read_text().splitlines() if step and path.exists() else []
        self._lines = [line for line in lines if json.loads(line)["step"] <= step]

    def write(self, entry: dict) -> None:
        self._lines.append(json.dumps(entry))
        atomic_write(self._path, "\n".join(self._lines) + "\n")


@contextmanager
def _one_torch_thread() -> Iterator[None]:
    """Sets torch to one thread, since its number of threads changes the order of sums; the pool has its own threads."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)


def _take_step(state: TrainingState, batch: BatchGradient, settings: PretrainSettings) -> TrainingState:
    queries = max(batch.queries, 1)
    error = batch.error / queries
    running = error if state.step == 0 else _ERROR_DECAY * state.running_error + (1 - _ERROR_DECAY) * error
    return state.adam_step(batch.gradient / queries, settings.learning_rate_at(state.step), running)


def _validate(state: TrainingState, settings: PretrainSettings) -> dict[str, dict[str, float]]:
    encoder_params, decoder_params = split_networks(state.parameters)
    return validate(encoder_params, decoder_params, settings.neighborhood, settings.min_pair_weight)


def _report(state: TrainingState, settings: PretrainSettings, log: _Log, progress: Progress | None) -> None:
    error_mm = state.running_error * settings.views.truncation * MM_PER_VOXEL
    if progress:
        progress(state.step, settings.steps, error_mm)
    last = state.step == settings.steps
    if last or state.step % _LOG_EVERY == 0:
        rate = settings.learning_rate_at(state.step - 1)
        log.write({"step": state.step, "error_mm": round(error_mm, 4), "learning_rate": rate})
    if last or state.step % _VALIDATE_EVERY == 0:
        log.write({"step": state.step, "validation": _validate(state, settings)})
