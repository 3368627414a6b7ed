"""The state of a training, and its checkpoint file."""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path

import torch
from safetensors.torch import save
from torch import Tensor

from spslam.errors import WeightsError, brief
from spslam.io import atomic_write
from spslam.prior.encoder import DECODER_WIDTHS, ENCODER_WIDTHS, parameter_count
from spslam.tensor_file import TensorFile, finite_number, load_header, load_tensors, whole_number
from spslam.tensor_schema import PRETRAINING

_BETA1, _BETA2, _EPSILON = 0.9, 0.999, 1e-8
_TENSORS = ("parameters", "exp_avg", "exp_avg_sq")
# A single metadata key: safetensors does not keep the order of several.
_KEY = "pretraining"
_FILE = TensorFile("checkpoint of spslam pretrain", PRETRAINING, header=_KEY, error=WeightsError)


@dataclass(frozen=True)
class TrainingState:
    """State of a training.

    Attributes:
        step: number of completed steps.
        parameters: float32 [P], see `spslam.prior.training.split_networks`.
        exp_avg: float32 [P], first moments of Adam.
        exp_avg_sq: float32 [P], second moments of Adam.
        running_error: running mean of the absolute SDF error, in truncations.
    """

    step: int
    parameters: Tensor
    exp_avg: Tensor
    exp_avg_sq: Tensor
    running_error: float

    @classmethod
    def start(cls, parameters: Tensor) -> TrainingState:
        """The state before the first step."""
        return cls(0, parameters, torch.zeros_like(parameters), torch.zeros_like(parameters), 0.0)

    def adam_step(self, gradient: Tensor, learning_rate: float, running_error: float) -> TrainingState:
        """The state after one Adam step."""
        step = self.step + 1
        exp_avg = _BETA1 * self.exp_avg + (1 - _BETA1) * gradient
        exp_avg_sq = _BETA2 * self.exp_avg_sq + (1 - _BETA2) * gradient.square()
        scale = (exp_avg_sq / (1 - _BETA2**step)).sqrt() + _EPSILON
        parameters = self.parameters - learning_rate / (1 - _BETA1**step) * exp_avg / scale
        return TrainingState(step, parameters, exp_avg, exp_avg_sq, running_error)


def save_state(path: Path, state: TrainingState, settings: dict) -> None:
    """Writes a checkpoint, atomically.

    Raises:
        OutputError: the file cannot be written.
    """
    header = {"settings": settings, "step": state.step, "running_error": state.running_error}
    tensors = {name: getattr(state, name) for name in _TENSORS}
    atomic_write(path, save(tensors, metadata={_KEY: json.dumps(header, sort_keys=True)}))


def load_state(path: Path, settings: dict) -> TrainingState:
    """Reads a checkpoint of a training with the same settings.

    Args:
        path: a file that `save_state` wrote.
        settings: of this training, as they were given to `save_state`.

    Raises:
        WeightsError: no readable checkpoint, or one of other settings; names the first option that differs.
    """
    header = load_header(path, _FILE)
    before = header.get("settings")
    if not isinstance(before, dict):
        raise WeightsError(f"{path}: a damaged {_FILE.what} (settings must be an object, got {brief(before)})")
    for name, value in settings.items():
        if before.get(name) != value:
            raise WeightsError(
                f"{path}: must be resumed with {name} = {brief(before.get(name))}, got {value}; "
                "remove the file to start from the beginning"
            )
    tensors = load_tensors(
        path, _FILE, {"parameters": parameter_count(ENCODER_WIDTHS) + parameter_count(DECODER_WIDTHS)}
    )
    try:
        step = whole_number(header, "step", high=settings["steps"])
        running_error = finite_number(header, "running_error", low=0)
    except ValueError as fault:
        raise WeightsError(f"{path}: a damaged {_FILE.what} ({fault})") from None
    return TrainingState(step, running_error=running_error, **tensors)
