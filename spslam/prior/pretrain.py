"""Pretraining of the scene prior: the depth encoder and its geometry decoder together, on procedural solids.

The loss is the mean over valid queries of ``|tanh(s) - sdf/tr|``, weighted more near the surface, plus a small multiple
of the features' length. The networks live in voxel units, so one file serves every voxel size whose truncation is as
many voxels. The decoder's weights of the position are kept at 0: it then ignores the position exactly, which a decoder
trained on random positions learns only nearly, and its features come out 6 % less exact for the effort.
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
_MEMORY = 0.98

Progress = Callable[[int, int, float], None]


def pretrain(
    output: str | os.PathLike,
    settings: PretrainSettings | None = None,
    resume: bool = False,
    workers: int | None = None,
    progress: Progress | None = None,
) -> dict:
    """Train encoder and decoder and write them as one safetensors file, with their provenance.

    Beside ``output`` lie ``<stem>.log.jsonl`` (error and validation along the way) and, until the end,
    ``<stem>.checkpoint.safetensors``. The same settings give the same bytes on one kind of processor, whether
    interrupted or not and for any number of workers.

    Parameters
    ----------
    output : the file of weights.
    settings : PretrainSettings() if not given.
    resume : go on from the checkpoint beside ``output``; without one, start anew.
    workers : threads; as many as processors if not given.
    progress : called with (steps done, steps, running mean error in mm at 4 cm voxels).

    Returns
    -------
    The provenance: script version, settings, kinds of solids and the validation figures.

    Raises
    ------
    WeightsError
        The checkpoint is damaged or belongs to other settings.
    OutputError
        A file can't be written. On KeyboardInterrupt a checkpoint is written before the exception goes on.
    """
    settings = settings or PretrainSettings()
    files = training_files(output)
    state = load_state(files.checkpoint, asdict(settings)) if resume and files.checkpoint.exists() else None
    state = state or TrainingState.start(initial_networks(settings.seed))
    log = _Log(files.log, state.step)
    with _one_torch_thread(), TrainingPool(workers or os.cpu_count() or 1, settings) as pool:
        try:
            for batch in pool.batches(state.step):
                reached = _take_step(state, pool.gradient(state.parameters, batch), settings)
                _report(reached, settings, log, progress)
                # Only now: a step whose report was interrupted is repeated.
                state = reached
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
    """Where a training writes."""

    weights: Path
    log: Path
    checkpoint: Path
    plot: Path


def training_files(output: str | os.PathLike) -> TrainingFiles:
    """The files that go with a file of weights."""
    output = Path(output)
    suffixes = (".log.jsonl", ".checkpoint.safetensors", ".png")
    return TrainingFiles(output, *(output.with_suffix(suffix) for suffix in suffixes))


class _Log:
    """One JSON object a line. Lines after ``step`` are of steps about to be repeated, and go."""

    def __init__(self, path: Path, step: int) -> None:
        self._path = path
        lines = path.read_text().splitlines() if step and path.exists() else []
        self._lines = [line for line in lines if json.loads(line)["step"] <= step]

    def write(self, entry: dict) -> None:
        self._lines.append(json.dumps(entry))
        atomic_write(self._path, "\n".join(self._lines) + "\n")


@contextmanager
def _one_torch_thread() -> Iterator[None]:
    """The order of sums within an operation depends on torch's threads; the pool's threads share the work instead."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(threads)


def _take_step(state: TrainingState, batch: BatchGradient, settings: PretrainSettings) -> TrainingState:
    queries = max(batch.queries, 1)
    error = batch.error / queries
    running = error if state.step == 0 else _MEMORY * state.running_error + (1 - _MEMORY) * error
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
